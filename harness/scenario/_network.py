"""Describe the network of a scenario: loss, delay, partitions, and radio loss that depends on distance.

The network conditions have three layers: the conditions of all links, of single receivers, and of single links. A more
specific layer replaces the values of the keys that it contains. `netem.conditions` defines the values and their valid
combinations. This module defines the notation of the values in a scenario. `NetworkModel` describes the network of the
whole mission, and `NetworkLayer` a change of it.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, model_validator

from harness.scenario._channel import ChannelModel
from harness.scenario.strict_model import MAX_AGENTS, Probability, StrictModel, VehicleId, VehicleKey
from netem import radio
from netem.conditions import Delay, Distribution, GilbertElliott, LinkConditions, NetworkConditions
from netem.errors import ConditionsError
from netem.link import MAX_DELAY_S, MAX_LIMIT


class HardRange(StrictModel):
    """A radio that loses no message within `range_m`, and every message beyond it."""

    range_m: float = radio.HardRange.range_m
    """Range in metres, above 0. The default is a typical outdoor range of IEEE 802.11n."""

    @model_validator(mode="after")
    def _check_values(self) -> "HardRange":
        radio.HardRange(self.range_m)
        return self


class LogDistance(StrictModel):
    """Log-distance path loss with log-normal shadowing. `netem.radio.LogDistance` has the formula and the sources."""

    exponent: float = radio.LogDistance.exponent
    """Path loss exponent, above 0."""
    shadowing_db: float = radio.LogDistance.shadowing_db
    """Standard deviation of the shadowing in decibels, at least 0."""
    power_dbm: float = radio.LogDistance.power_dbm
    """Transmit power in dBm."""
    sensitivity_dbm: float = radio.LogDistance.sensitivity_dbm
    """Minimum received power in dBm. A message with less power is lost."""
    frequency_hz: float = radio.LogDistance.frequency_hz
    """Carrier frequency in hertz, above 0."""

    @model_validator(mode="after")
    def _check_values(self) -> "LogDistance":
        radio.LogDistance(**self.model_dump())
        return self


class RadioModel(StrictModel):
    """Loss that depends on the distance between two vehicles. Needs exactly one of `hard_range` and `log_distance`."""

    hard_range: HardRange | None = None
    """A radio with a fixed range."""
    log_distance: LogDistance | None = None
    """A radio with a loss that grows with the distance."""
    update_s: Annotated[float, Field(ge=0.1, le=60)] = 1.0
    """Mission seconds between two updates of the loss. For agents that are processes, there are at most ten updates per
    second.
    """

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


class BurstLoss(StrictModel):
    """Loss in bursts by the Gilbert-Elliott model, as `loss gemodel p r 1-h 1-k` of tc-netem(8).

    Each link has its own state, good or bad, and starts in the good state. After each message the state may change.
    """

    p: Probability
    """Probability of a change from the good to the bad state."""
    r: Probability
    """Probability of a change from the bad to the good state."""
    loss_bad: Probability = 1.0
    """Probability that a message is lost in the bad state."""
    loss_good: Probability = 0.0
    """Probability that a message is lost in the good state."""


DelaySeconds = Annotated[float, Field(ge=0, le=MAX_DELAY_S, allow_inf_nan=False)]


class RandomDelay(StrictModel):
    """A random delay, as `delay` and `distribution` of tc-netem(8). Times are mission seconds."""

    mean_s: DelaySeconds
    """Mean of the delay."""
    jitter_s: DelaySeconds = 0.0
    """Greatest deviation of a uniform delay, or standard deviation of the other distributions. At most `mean_s`."""
    distribution: Distribution = "uniform"
    """Distribution of the delay. A negative delay becomes 0."""

    @model_validator(mode="after")
    def _check_values(self) -> "RandomDelay":
        Delay(**self.model_dump())
        return self


def _number_or(mapping: type[StrictModel], number: Any) -> BeforeValidator:
    """Return a validator for a value that is a mapping or a number. The error message for an invalid value mentions
    only the form that the user chose.
    """
    numbers = TypeAdapter(number)

    def choose(value: Any) -> Any:
        return mapping.model_validate(value) if isinstance(value, Mapping | mapping) else numbers.validate_python(value)

    return BeforeValidator(choose)


def _or_none(number: Any) -> BeforeValidator:
    """Return a validator for a value that is a number or the word `none`. The error message for an invalid value
    mentions only the number.
    """
    numbers = TypeAdapter(number)
    return BeforeValidator(lambda value: value if value == "none" else numbers.validate_python(value))


BitsPerSecond = Annotated[float, Field(ge=8, allow_inf_nan=False)]
Packets = Annotated[int, Field(ge=1, le=MAX_LIMIT, strict=True)]
Rate = Annotated[BitsPerSecond | Literal["none"], _or_none(BitsPerSecond)]
Limit = Annotated[Packets | Literal["none"], _or_none(Packets)]
Loss = Annotated[Probability | BurstLoss, _number_or(BurstLoss, Probability)]
DelayTime = Annotated[DelaySeconds | RandomDelay, _number_or(RandomDelay, DelaySeconds)]
VehicleIds = Annotated[
    list[VehicleId],
    Field(min_length=1, max_length=MAX_AGENTS),
    BeforeValidator(
        lambda value: value if isinstance(value, list) else [value], json_schema_input_type=VehicleId | list[VehicleId]
    ),
]


class ConditionOverrides(StrictModel):
    """Network conditions that replace the conditions of an earlier or more general setting. If a key is missing, the
    value of the earlier setting applies.
    """

    loss: Loss | None = None
    """Probability that a message is lost, or loss in bursts."""
    delay: DelayTime | None = None
    """Delay in mission seconds, 0 to 60, or a distribution of delays."""
    duplicate: Probability | None = None
    """Probability that a message arrives twice."""
    reorder: Probability | None = None
    """Probability that a message is sent without the delay and overtakes other messages. If it is above 0, a `delay` is
    required.
    """
    corrupt: Probability | None = None
    """Probability that one bit of a message flips. The receiver drops a message with a flipped bit because of its
    checksum.
    """
    rate: Rate | None = None
    """Bits per mission second from each sender to each receiver, headers included, at least 8. With `none`, there is no
    limit.
    """
    limit: Limit | None = None
    """Maximum number of messages from one sender to one receiver that wait because of the delay or the rate, 1 to
    100,000. Further messages are lost. With `none`, there is no limit. A `limit` requires a `delay` or a `rate`.
    """

    def given(self) -> dict[str, object]:
        """Return the conditions that the scenario sets, by key."""
        return {key: value for key in KEYS if (value := getattr(self, key)) is not None}


KEYS = tuple(ConditionOverrides.model_fields)


class ReceiverOverrides(ConditionOverrides):
    """Network conditions for all messages to one vehicle. If a key is missing, the value of the whole network
    applies.
    """


class LinkOverrides(ConditionOverrides):
    """Network conditions of the links from each vehicle of `from` to each vehicle of `to`.

    If a key is missing, the value of the receiver applies. Two entries for the same link are an error.
    """

    model_config = ConfigDict(serialize_by_alias=True)

    from_: VehicleIds = Field(alias="from")
    """ID of the sender, or a list of senders."""
    to: VehicleIds
    """ID of the receiver, or a list of receivers. It is an error if a vehicle is both a sender and a receiver."""
    both: bool = False
    """True if the conditions also apply to the opposite direction."""

    def pairs(self) -> Iterator[tuple[int, int]]:
        for sender, receiver in product(self.from_, self.to):
            yield sender, receiver
            if self.both:
                yield receiver, sender


Scope = None | int | tuple[int, int]
"""Scope of a condition: None for all links, a vehicle ID for one receiver, or (sender, receiver) for one link."""
NetworkValues = dict[Scope, dict[str, Any]]
"""Network conditions, or a change of them: scope -> key -> value."""


class NetworkLayer(ConditionOverrides):
    """A change of the network for all links, single receivers or single links. Needs at least one key."""

    receivers: dict[VehicleKey, ReceiverOverrides] = {}
    """Conditions of single receivers, by vehicle ID."""
    links: Annotated[list[LinkOverrides], Field(max_length=10_000)] = []
    """Conditions of single links, at most 10,000 entries."""

    @model_validator(mode="after")
    def _check_values(self) -> "NetworkLayer":
        if self.by_scope() == {None: {}}:
            raise ValueError(f"needs at least one of {', '.join(f'`{key}`' for key in type(self).model_fields)}")
        return self

    def by_scope(self) -> NetworkValues:
        """Return the conditions by scope: all links, one receiver, or one link. Raises ConditionsError if two entries
        concern the same link.
        """
        return {None: self.given(), **_values_of(self.receivers, self.links)}

    def named_vehicles(self) -> Iterator[tuple[str, int]]:
        """Yield each vehicle ID in the network section, with the key that contains it."""
        return _named(self.receivers, self.links)


class NetworkDisturbance(StrictModel):
    """A change of the network, as timeline entries and schedules contain it."""

    loss: Loss | None = None
    """Probability that a message is lost, or loss in bursts. The same as `network: {loss: ...}`."""
    partition: list[list[VehicleId]] | None = None
    """Groups of vehicles. Messages between different groups are lost. Vehicles in no group form a further group."""
    network: NetworkLayer | None = None
    """Other conditions of the network. Conditions that are not listed do not change."""

    @model_validator(mode="after")
    def _check_loss(self) -> "NetworkDisturbance":
        if self.loss is not None and self.network is not None and self.network.loss is not None:
            raise ValueError("`loss` and `network.loss` are the same setting: leave out one of them")
        return self

    def changes(self) -> NetworkValues:
        """Return the changed network conditions, without the partition."""
        values: NetworkValues = self.network.by_scope() if self.network else {}
        return values if self.loss is None else overlay(values, {None: {"loss": self.loss}})

    @property
    def groups(self) -> tuple[frozenset[int], ...]:
        """The groups of vehicles into which the partition divides the network."""
        return tuple(frozenset(group) for group in self.partition or ())


class NetworkModel(StrictModel):
    """Network conditions. Loss and delay are drawn at random for each receiver, so a broadcast may reach only some
    receivers.
    """

    loss: Loss = 0.0
    """Probability that a message is lost, or loss in bursts."""
    delay: DelayTime = 0.0
    """Delay in mission seconds, 0 to 60, or a distribution of delays."""
    duplicate: Probability = 0.0
    """Probability that a message arrives twice."""
    reorder: Probability = 0.0
    """Probability that a message is sent without the delay and overtakes other messages. If it is above 0, a `delay` is
    required.
    """
    corrupt: Probability = 0.0
    """Probability that one bit of a message flips. The receiver drops a message with a flipped bit because of its
    checksum.
    """
    rate: Rate = "none"
    """Bits per mission second from each sender to each receiver, headers included, at least 8. With `none`, there is no
    limit.
    """
    limit: Limit = "none"
    """Maximum number of messages from one sender to one receiver that wait because of the delay or the rate, 1 to
    100,000. Further messages are lost. With `none`, there is no limit. A `limit` requires a `delay` or a `rate`.
    """
    receivers: dict[VehicleKey, ReceiverOverrides] = {}
    """Conditions of single receivers, by vehicle ID."""
    links: Annotated[list[LinkOverrides], Field(max_length=10_000)] = []
    """Conditions of single links, at most 10,000 entries."""
    radio: RadioModel | None = None
    """Additional loss that depends on the distance between two vehicles. Without it, distance has no effect."""
    channel: ChannelModel | None = None
    """A radio channel that all vehicles share. Without a shared channel, all vehicles may send at the same time."""

    @model_validator(mode="after")
    def _check_values(self) -> "NetworkModel":
        self.conditions()
        if self.radio is not None and self.channel is not None:
            raise ValueError("`radio` and `channel` both compute the loss over distance: leave out one of them")
        return self

    def named_vehicles(self) -> Iterator[tuple[str, int]]:
        """Yield each vehicle ID in the network section, with the key that contains it."""
        return _named(self.receivers, self.links)

    def by_scope(self) -> NetworkValues:
        """Return the conditions by scope: all links, one receiver, or one link. Raises ConditionsError if two entries
        concern the same link.
        """
        return {None: {key: getattr(self, key) for key in KEYS}, **_values_of(self.receivers, self.links)}

    def conditions(self, partition: tuple[frozenset[int], ...] = ()) -> NetworkConditions:
        """Return the network conditions of all links. Raises ConditionsError if values contradict each other."""
        return conditions_of(self.by_scope(), partition)


def _named(receivers: Mapping[int, ReceiverOverrides], links: Sequence[LinkOverrides]) -> Iterator[tuple[str, int]]:
    yield from (("receivers", vehicle) for vehicle in receivers)
    for index, link in enumerate(links):
        yield from ((f"links.{index}.from", vehicle) for vehicle in link.from_)
        yield from ((f"links.{index}.to", vehicle) for vehicle in link.to)


def _values_of(receivers: Mapping[int, ReceiverOverrides], links: Sequence[LinkOverrides]) -> NetworkValues:
    differences: NetworkValues = {vehicle: receiver.given() for vehicle, receiver in receivers.items()}
    for index, link in enumerate(links):
        keys = link.given()
        for sender, receiver in link.pairs():
            if sender == receiver:
                raise ConditionsError(f"links.{index}: a link from vehicle {sender} to itself is impossible")
            if (sender, receiver) in differences:
                raise ConditionsError(
                    f"links.{index}: from {sender} to {receiver} is named twice: leave out one of them"
                )
            differences[sender, receiver] = keys
    return differences


def overlay(network: NetworkValues, layer: NetworkValues) -> NetworkValues:
    """Return the network conditions in which the values of `layer` have replaced the values of `network`."""
    return {scope: network.get(scope, {}) | layer.get(scope, {}) for scope in (*network, *layer)}


def scope_in_words(scope: Scope) -> str:
    """Describe the affected links in a phrase for the end of a sentence, as in "loss from 1 to 2"."""
    if scope is None:
        return ""
    return f" from {scope[0]} to {scope[1]}" if isinstance(scope, tuple) else f" to {scope}"


def conditions_of(network: NetworkValues, partition: tuple[frozenset[int], ...] = ()) -> NetworkConditions:
    """Convert network values to network conditions. Raises ConditionsError if the values contradict each other."""
    for_all = network[None]
    conditions: dict[Scope, LinkConditions] = {}
    known: dict[tuple[Any, ...], LinkConditions] = {}  # of many links there are few kinds
    for scope, keys in network.items():
        receiver = scope[1] if isinstance(scope, tuple) else scope
        last = for_all | network.get(receiver, {}) | keys
        values = tuple(last[key] for key in KEYS)
        if values not in known:
            try:
                known[values] = _conditions(last)
            except ConditionsError as error:
                raise ConditionsError(f"{_key(scope)}{error}") from None
        conditions[scope] = known[values]
    receivers = {scope: link for scope, link in conditions.items() if isinstance(scope, int)}
    links = {scope: link for scope, link in conditions.items() if isinstance(scope, tuple)}
    return NetworkConditions(conditions[None], receivers, links, partition)


def _key(scope: Scope) -> str:
    if scope is None:
        return ""
    return f"links from {scope[0]} to {scope[1]}: " if isinstance(scope, tuple) else f"receivers.{scope}: "


def _conditions(keys: dict[str, Any]) -> LinkConditions:
    loss, delay = keys["loss"], keys["delay"]
    values = keys | {key: None for key in ("rate", "limit") if keys[key] == "none"}
    values["loss"] = GilbertElliott(**loss.model_dump()) if isinstance(loss, BurstLoss) else loss
    values["delay"] = Delay(**delay.model_dump()) if isinstance(delay, RandomDelay) else Delay(delay)
    return LinkConditions(**values)
