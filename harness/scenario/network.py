"""The air of a scenario: what happens to messages on the way from one vehicle to another.

Three layers: the network, receivers that differ from it, links that differ from their receiver. A layer changes
the keys that it names. What the values mean, and which go together, `netem.conditions` says; here is how they are
written.
"""

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, model_validator

from harness.scenario.model import MAX_AGENTS, Model, Probability, VehicleId, VehicleKey
from harness.scenario.radio import RadioModel
from netem.conditions import Delay, Distribution, GilbertElliott, LinkConditions, NetworkConditions
from netem.errors import ConditionsError
from netem.link import MAX_DELAY_S, MAX_LIMIT


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
        yield from (("receivers", vehicle) for vehicle in self.receivers)
        for index, link in enumerate(self.links):
            yield from ((f"links.{index}.from", vehicle) for vehicle in link.from_)
            yield from ((f"links.{index}.to", vehicle) for vehicle in link.to)

    def conditions(self, partition: tuple[frozenset[int], ...] = ()) -> NetworkConditions:
        """The conditions that these words mean; raises ConditionsError if they contradict each other."""
        links: dict[tuple[int, int], LinkConditions] = {}
        for index, link in enumerate(self.links):
            where = f"links.{index}: "
            # One value per receiver, however many send to it.
            values: dict[int, LinkConditions] = {}
            for sender, receiver in link.pairs():
                if sender == receiver:
                    raise ConditionsError(f"{where}a link from vehicle {sender} to itself carries nothing")
                if (sender, receiver) in links:
                    raise ConditionsError(f"{where}from {sender} to {receiver} is named twice: which one counts?")
                if receiver not in values:
                    values[receiver] = _conditions(where, self, self.receivers.get(receiver), link)
                links[sender, receiver] = values[receiver]
        return NetworkConditions(
            _conditions("", self),
            {vehicle: _conditions(f"receivers.{vehicle}: ", self, it) for vehicle, it in self.receivers.items()},
            links,
            partition,
        )


def _conditions(where: str, *layers: NetworkModel | Difference | None) -> LinkConditions:
    """What the layers make together: of each key, the last word."""
    last: dict[str, Any] = {}
    for layer in layers:
        for key in Difference.model_fields:
            if (value := getattr(layer, key, None)) is not None:
                last[key] = value
    loss, delay = last["loss"], last["delay"]
    last |= {key: None for key in ("rate", "limit") if last[key] == "none"}
    last["loss"] = GilbertElliott(**loss.model_dump()) if isinstance(loss, Bursts) else loss
    last["delay"] = Delay(**delay.model_dump()) if isinstance(delay, Jitter) else Delay(delay)
    try:
        return LinkConditions(**last)
    except ConditionsError as error:
        raise ConditionsError(f"{where}{error}") from None
