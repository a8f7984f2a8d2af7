"""The network of a scenario: loss, delay, partitions, and the radio's loss over distance.

Three layers: the network, receivers that differ from it, links that differ from their receiver. A layer changes
the keys that it names. What the values mean, and which go together, `netem.conditions` says; here is how they are
written, for the whole mission or, laid over that, from some time on: `NetworkLayer`.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, model_validator

from harness.scenario.strict_model import MAX_AGENTS, Model, Probability, VehicleId, VehicleKey
from netem import radio
from netem.conditions import Delay, Distribution, GilbertElliott, LinkConditions, NetworkConditions
from netem.errors import ConditionsError
from netem.link import MAX_DELAY_S, MAX_LIMIT


class HardRange(Model):
    """Whoever is within `range_m` hears everything, whoever is not hears nothing."""

    range_m: float = radio.HardRange.range_m

    @model_validator(mode="after")
    def _means_something(self) -> "HardRange":
        radio.HardRange(self.range_m)
        return self


class LogDistance(Model):
    """Log-distance path loss with shadowing; `netem.radio.LogDistance` says what the figures are and where from."""

    exponent: float = radio.LogDistance.exponent
    shadowing_db: float = radio.LogDistance.shadowing_db
    power_dbm: float = radio.LogDistance.power_dbm
    sensitivity_dbm: float = radio.LogDistance.sensitivity_dbm
    frequency_hz: float = radio.LogDistance.frequency_hz

    @model_validator(mode="after")
    def _means_something(self) -> "LogDistance":
        radio.LogDistance(**self.model_dump())
        return self


class RadioModel(Model):
    """One of `hard_range` and `log_distance`.

    Every `update_s` mission seconds conditions follow the vehicles; as processes, at most ten times a second.
    """

    hard_range: HardRange | None = None
    log_distance: LogDistance | None = None
    update_s: Annotated[float, Field(ge=0.1, le=60)] = 1.0

    def radio(self) -> radio.Radio:
        if self.hard_range is not None:
            return radio.HardRange(self.hard_range.range_m)
        assert self.log_distance is not None
        return radio.LogDistance(**self.log_distance.model_dump())

    @model_validator(mode="after")
    def _one_model(self) -> "RadioModel":
        if (self.hard_range is None) == (self.log_distance is None):
            raise ValueError("needs one of `hard_range` and `log_distance`")
        return self


class Bursts(Model):
    """Loss in bursts: tc-netem(8) `loss gemodel p r 1-h 1-k`.

    `p`: probability per message that a link goes bad; `r`: that it recovers; `loss_bad` and `loss_good`: loss in
    either state.
    """

    p: Probability
    r: Probability
    loss_bad: Probability = 1.0
    loss_good: Probability = 0.0


DelaySeconds = Annotated[float, Field(ge=0, le=MAX_DELAY_S, allow_inf_nan=False)]


class Jitter(Model):
    """Delay that varies: `jitter_s` to either side if `uniform`, else the standard deviation, as in tc-netem(8)."""

    mean_s: DelaySeconds
    jitter_s: DelaySeconds = 0.0
    distribution: Distribution = "uniform"

    @model_validator(mode="after")
    def _means_something(self) -> "Jitter":
        Delay(**self.model_dump())
        return self


def _number_or(mapping: type[Model], number: Any) -> BeforeValidator:
    """For a union of the two: tries the one that was meant, so that an error speaks of it alone."""
    numbers = TypeAdapter(number)

    def choose(value: Any) -> Any:
        return mapping.model_validate(value) if isinstance(value, Mapping | mapping) else numbers.validate_python(value)

    return BeforeValidator(choose)


def _or_none(number: Any) -> BeforeValidator:
    """For a union with the word none: an error speaks of the number alone."""
    numbers = TypeAdapter(number)
    return BeforeValidator(lambda value: value if value == "none" else numbers.validate_python(value))


BitsPerSecond = Annotated[float, Field(ge=8, allow_inf_nan=False)]
Packets = Annotated[int, Field(ge=1, le=MAX_LIMIT, strict=True)]
Rate = Annotated[BitsPerSecond | Literal["none"], _or_none(BitsPerSecond)]
Limit = Annotated[Packets | Literal["none"], _or_none(Packets)]
Loss = Annotated[Probability | Bursts, _number_or(Bursts, Probability)]
DelayTime = Annotated[DelaySeconds | Jitter, _number_or(Jitter, DelaySeconds)]
Vehicles = Annotated[
    list[VehicleId],
    Field(min_length=1, max_length=MAX_AGENTS),
    BeforeValidator(
        lambda value: value if isinstance(value, list) else [value], json_schema_input_type=VehicleId | list[VehicleId]
    ),
]


class Difference(Model):
    """A layer: keys that are not given stay as the layer below has them."""

    loss: Loss | None = None
    delay: DelayTime | None = None
    duplicate: Probability | None = None
    reorder: Probability | None = None
    corrupt: Probability | None = None
    rate: Rate | None = None
    limit: Limit | None = None

    def given(self) -> dict[str, Any]:
        """The keys that are given."""
        return {key: value for key in KEYS if (value := getattr(self, key)) is not None}


KEYS = tuple(Difference.model_fields)


class Receiver(Difference):
    """What one vehicle hears, where it differs from the network."""


class Link(Difference):
    """From each vehicle of `from` to each of `to`, where it differs from what they else receive.

    `both`: and in the other direction.
    """

    model_config = ConfigDict(serialize_by_alias=True)

    from_: Vehicles = Field(alias="from")
    to: Vehicles
    both: bool = False

    def pairs(self) -> Iterator[tuple[int, int]]:
        for sender, receiver in product(self.from_, self.to):
            yield sender, receiver
            if self.both:
                yield receiver, sender


Where = None | int | tuple[int, int]
"""Of whom something is said: of all, of what one vehicle hears, or of a link, from sender to receiver."""
NetworkValues = dict[Where, dict[str, Any]]
"""A network, or what changes of it: whose keys have which values."""


class NetworkLayer(Difference):
    """What is laid over the network as it stands, key by key: for all, for receivers, for links."""

    receivers: dict[VehicleKey, Receiver] = {}
    links: Annotated[list[Link], Field(max_length=10_000)] = []

    @model_validator(mode="after")
    def _says_something(self) -> "NetworkLayer":
        if self.whole() == {None: {}}:
            raise ValueError(f"needs at least one of {', '.join(f'`{key}`' for key in type(self).model_fields)}")
        return self

    def whole(self) -> NetworkValues:
        """Raises ConditionsError if it says something twice."""
        return {None: self.given(), **_values_of(self.receivers, self.links)}

    def named(self) -> Iterator[tuple[str, int]]:
        """Every vehicle that is named, with the key that names it."""
        return _named(self.receivers, self.links)


class Disturbance(Model):
    """The language of timeline and schedules: what becomes of the network. `loss` is short for a `network` of it."""

    loss: Loss | None = None
    partition: list[list[VehicleId]] | None = None
    network: NetworkLayer | None = None

    @model_validator(mode="after")
    def _says_no_loss_twice(self) -> "Disturbance":
        if self.loss is not None and self.network is not None and self.network.loss is not None:
            raise ValueError("`loss` and `network.loss` are the same thing: leave one of them out")
        return self

    def changes(self) -> NetworkValues:
        """What it changes of the network, partitions apart."""
        values: NetworkValues = self.network.whole() if self.network else {}
        return values if self.loss is None else laid_over(values, {None: {"loss": self.loss}})

    @property
    def groups(self) -> tuple[frozenset[int], ...]:
        """Those of its partition."""
        return tuple(frozenset(group) for group in self.partition or ())


class NetworkModel(Model):
    """What happens to every message, for each receiver independently; receivers and links that differ."""

    loss: Loss = 0.0
    """The probability that a message is lost, or loss in bursts."""
    delay: DelayTime = 0.0
    """Mission seconds."""
    duplicate: Probability = 0.0
    """The probability that a message comes twice."""
    reorder: Probability = 0.0
    """The probability that a message overtakes: it is sent at once, without the delay."""
    corrupt: Probability = 0.0
    """The probability that one bit of a message flips, which its receiver notices and throws it away."""
    rate: Rate = "none"
    """Bits per mission second from each sender to each receiver, headers included."""
    limit: Limit = "none"
    """How many messages from one sender to one receiver may wait for delay or rate; what exceeds it is lost."""
    receivers: dict[VehicleKey, Receiver] = {}
    links: Annotated[list[Link], Field(max_length=10_000)] = []
    radio: RadioModel | None = None
    """What is lost over the distance between two vehicles, besides; None: distance does not matter."""

    @model_validator(mode="after")
    def _means_something(self) -> "NetworkModel":
        self.conditions()
        return self

    def named(self) -> Iterator[tuple[str, int]]:
        """Every vehicle that is named, with the key that names it."""
        return _named(self.receivers, self.links)

    def whole(self) -> NetworkValues:
        """Raises ConditionsError if it says something twice."""
        return {None: {key: getattr(self, key) for key in KEYS}, **_values_of(self.receivers, self.links)}

    def conditions(self, partition: tuple[frozenset[int], ...] = ()) -> NetworkConditions:
        """The conditions that these words mean; raises ConditionsError if they contradict each other."""
        return conditions_of(self.whole(), partition)


def _named(receivers: Mapping[int, Receiver], links: Sequence[Link]) -> Iterator[tuple[str, int]]:
    yield from (("receivers", vehicle) for vehicle in receivers)
    for index, link in enumerate(links):
        yield from ((f"links.{index}.from", vehicle) for vehicle in link.from_)
        yield from ((f"links.{index}.to", vehicle) for vehicle in link.to)


def _values_of(receivers: Mapping[int, Receiver], links: Sequence[Link]) -> NetworkValues:
    differences: NetworkValues = {vehicle: receiver.given() for vehicle, receiver in receivers.items()}
    for index, link in enumerate(links):
        keys = link.given()
        for sender, receiver in link.pairs():
            if sender == receiver:
                raise ConditionsError(f"links.{index}: a link from vehicle {sender} to itself carries nothing")
            if (sender, receiver) in differences:
                raise ConditionsError(f"links.{index}: from {sender} to {receiver} is named twice: which one counts?")
            differences[sender, receiver] = keys
    return differences


def laid_over(network: NetworkValues, layer: NetworkValues) -> NetworkValues:
    """What the layer says counts, of whomever it says it; what it does not say stays."""
    return {where: network.get(where, {}) | layer.get(where, {}) for where in (*network, *layer)}


def of_whom(where: Where) -> str:
    """In words, to put after a key: "loss from 1 to 2"."""
    if where is None:
        return ""
    return f" from {where[0]} to {where[1]}" if isinstance(where, tuple) else f" to {where}"


def conditions_of(network: NetworkValues, partition: tuple[frozenset[int], ...] = ()) -> NetworkConditions:
    """The conditions that a whole network comes to; raises ConditionsError if its keys contradict each other."""
    for_all = network[None]
    conditions: dict[Where, LinkConditions] = {}
    known: dict[tuple[Any, ...], LinkConditions] = {}  # of many links there are few kinds
    for where, keys in network.items():
        receiver = where[1] if isinstance(where, tuple) else where
        last = for_all | network.get(receiver, {}) | keys
        values = tuple(last[key] for key in KEYS)
        if values not in known:
            try:
                known[values] = _conditions(last)
            except ConditionsError as error:
                raise ConditionsError(f"{_key(where)}{error}") from None
        conditions[where] = known[values]
    receivers = {where: link for where, link in conditions.items() if isinstance(where, int)}
    links = {where: link for where, link in conditions.items() if isinstance(where, tuple)}
    return NetworkConditions(conditions[None], receivers, links, partition)


def _key(where: Where) -> str:
    if where is None:
        return ""
    return f"links from {where[0]} to {where[1]}: " if isinstance(where, tuple) else f"receivers.{where}: "


def _conditions(keys: dict[str, Any]) -> LinkConditions:
    loss, delay = keys["loss"], keys["delay"]
    values = keys | {key: None for key in ("rate", "limit") if keys[key] == "none"}
    values["loss"] = GilbertElliott(**loss.model_dump()) if isinstance(loss, Bursts) else loss
    values["delay"] = Delay(**delay.model_dump()) if isinstance(delay, Jitter) else Delay(delay)
    return LinkConditions(**values)
