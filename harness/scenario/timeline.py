"""Describe the timeline and the schedules of a scenario: changes of the network, faults and injections.

    schedule:
      - {ramp: {loss: [0, 0.5]}, from_s: 100, until_s: 400}
      - {repeat: {partition: [[1, 2]]}, every_s: 120, for_s: 30}
      - {repeat: {network: {links: [{from: 1, to: 2, loss: 0.9}]}}, every_s: 120, for_s: 30}
      - {nemesis: halves, every_s: 60, for_s: 20, seed: 7}

Each schedule is a layer on top of the network that the scenario and its timeline define. The layers are computed before
the run, so every backend plays the same changes. A schedule can change the same keys as a timeline entry: `loss`,
`partition`, and `network` with any of its keys. If several layers change the same key, the value of the last layer
applies. A message is lost if a partition of any layer separates sender and receiver.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

from pydantic import Field, ValidationInfo, create_model, field_validator, model_validator

from harness.scenario._network import (
    DelaySeconds,
    NetworkDisturbance,
    NetworkLayer,
    NetworkValues,
    Scope,
    overlay,
    scope_in_words,
)
from harness.scenario.faults import TIMELINE_FAULTS, AgentIds, Fault
from harness.scenario.injection import (
    INJECTIONS,
    CorruptedCopy,
    DelayedCopy,
    Duplicate,
    Flood,
    Forgery,
    Injection,
    InjectionName,
    Lie,
    Replay,
)
from harness.scenario.strict_model import MissionSecond, Probability, Seconds, StrictModel, VehicleId

NETWORK_KEYS = ("loss", "partition", "heal", "network")
"""Keys of a timeline entry that change the network."""


class _TimelineEntryBase(NetworkDisturbance):
    """One change at one mission second. An entry needs `at_s` and exactly one kind of change.

    A change of the network is `loss`, `partition`, `heal` or `network`. A fault, such as `kill`, has a list of agents.
    An injection, such as `replay`, makes a rogue node send messages. Two entries at the same mission second are an
    error.
    """

    at_s: MissionSecond
    """Mission second of the change, at most `duration_s`."""
    for_s: Seconds | None = None
    """Mission seconds until the end of a change by `loss`, `partition` or `network`. By default, the change lasts until
    a later change of the same value.
    """
    heal: Literal[True] | None = None
    """If true, the partition ends."""
    replay: Replay | None = None
    """The rogue node repeats messages that it received before."""
    duplicate: Duplicate | None = None
    """The rogue node repeats each matching message immediately."""
    delay: DelayedCopy | None = None
    """The rogue node repeats each message later."""
    corrupt: CorruptedCopy | None = None
    """The rogue node repeats each message with flipped bits."""
    forge: Forgery | None = None
    """The rogue node sends forged messages in the name of an agent."""
    flood: Flood | None = None
    """The rogue node sends random messages at a high rate."""
    lie: Lie | None = None
    """The rogue node sends one message with the given content in the name of an agent. In virtual time only."""

    @field_validator("delay", "duplicate", "corrupt", mode="before")
    @classmethod
    def _an_injection(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, int | float):
            of_the_network = f"`network: {{{info.field_name}: {value}}}`"
            raise ValueError(f"it is an action of a rogue node; {of_the_network} changes the network")
        return value

    @property
    def injection(self) -> tuple[InjectionName, Injection] | None:
        """The name and the parameters of the injection in this entry. None if the entry is not an injection."""
        return next(((name, injection) for name in INJECTIONS if (injection := getattr(self, name)) is not None), None)

    @property
    def fault(self) -> Fault | None:
        """The fault in this entry. None if the entry is not a fault."""
        for kind in TIMELINE_FAULTS:
            if (agents := getattr(self, kind.what)) is not None:
                return kind(self.at_s, tuple(agents), **{key: getattr(self, key) for key in kind.further_keys()})
        return None

    @property
    def network_key(self) -> str | None:
        """The key in this entry that changes the network. None if the entry does not change the network."""
        return next((key for key in NETWORK_KEYS if getattr(self, key) is not None), None)

    @property
    def ends_at_s(self) -> float:
        """The mission second at which the effect of the entry ends."""
        if (fault := self.fault) is not None:
            return fault.stages()[-1].at_s
        lasts_s = self.injection[1].lasts_s if self.injection else self.for_s or 0.0
        return round(self.at_s + lasts_s, 6)

    @model_validator(mode="after")
    def _one_change(self) -> "TimelineEntry":
        changes = (*NETWORK_KEYS, *(kind.what for kind in TIMELINE_FAULTS), *INJECTIONS)
        if sum(getattr(self, change) is not None for change in changes) != 1:
            named = (f"`{change}{': true' if change == 'heal' else ''}`" for change in changes)
            raise ValueError(f"needs exactly one of {', '.join(named)}")
        if self.for_s is not None and (self.heal or not self.network_key):
            raise ValueError("`for_s` belongs to `loss`, `partition` and `network`")
        for kind in TIMELINE_FAULTS:
            keys, is_meant = kind.further_keys(), getattr(self, kind.what) is not None
            given = [key for key in keys if getattr(self, key) is not None]
            if given and not is_meant:
                named = (f"`{key}`" for key in keys)
                raise ValueError(f"{' and '.join(named)} belong{'s' if len(keys) == 1 else ''} to `{kind.what}`")
            if is_meant and len(given) < len(keys):
                raise ValueError(f"a {kind.what} needs {kind.keys_in_words}")
        return self


def _keys_of_faults() -> dict[str, object]:
    """Return the model fields for the faults in a timeline entry. Each fault has a field for its name, and fields for
    its further keys.
    """
    annotations: dict[str, Any] = {}
    descriptions: dict[str, str] = {}
    for kind in TIMELINE_FAULTS:
        descriptions |= {kind.what: " ".join((kind.__doc__ or "").split()), **kind.key_descriptions}
        hints = get_type_hints(kind, include_extras=True)
        annotations |= {kind.what: AgentIds, **{key: hints[key] for key in kind.further_keys()}}
    return {
        key: (annotation | None, Field(None, description=descriptions.get(key)))
        for key, annotation in annotations.items()
    }


if TYPE_CHECKING:  # a type checker does not run the code that makes the class
    TimelineEntry = _TimelineEntryBase
else:
    TimelineEntry = create_model(
        "TimelineEntry", __base__=_TimelineEntryBase, __doc__=_TimelineEntryBase.__doc__, **_keys_of_faults()
    )


MAX_STEPS = 10_000
"""Maximum number of changes that one schedule makes."""

Groups = Annotated[list[list[VehicleId]], Field(min_length=1)]
Pairs = frozenset[tuple[int, int]]


@dataclass(frozen=True)
class TemporaryChange:
    """A temporary change of the network by a schedule. If all fields are empty, the change has no effect."""

    values: NetworkValues = field(default_factory=dict)
    partition: tuple[frozenset[int], ...] = ()
    cut: Pairs = frozenset()
    """Pairs (sender, receiver). All messages from this sender to this receiver are lost."""


EMPTY_LAYER = TemporaryChange()

LayerStep = tuple[float, str, TemporaryChange]
"""A step of a schedule: its mission second, the name of the change, and the layer that applies from this second on."""


class Ramp(StrictModel):
    """A change of network conditions in equal steps, from the first to the last values. Needs at least one key."""

    loss: tuple[Probability, Probability] | None = None
    """First and last probability that a message is lost."""
    delay: tuple[DelaySeconds, DelaySeconds] | None = None
    """First and last delay in mission seconds, 0 to 60."""
    network: tuple[NetworkLayer, NetworkLayer] | None = None
    """First and last network conditions. Both need the same keys, and each value must be a number."""

    @model_validator(mode="after")
    def _check_values(self) -> "Ramp":
        if self.loss is None and self.delay is None and self.network is None:
            raise ValueError("needs `loss`, `delay` or `network`: [from, to]")
        if self.network is not None:
            first, last = ({(scope, key): value for scope, key, value in _values(end)} for end in self._ends())
            for scope, key in first.keys() ^ last.keys():
                raise ValueError(f"{key}{scope_in_words(scope)} is in one `network` of the ramp only: give it in both")
            for (scope, key), value in [*first.items(), *last.items()]:
                if scope is None and getattr(self, key, None) is not None:
                    raise ValueError(f"`{key}` and `network.{key}` are the same setting: leave out one of them")
                if not isinstance(value, float):
                    raise ValueError(f"{key}{scope_in_words(scope)} is {value!r}: a ramp needs two numbers")
        return self

    def _ends(self) -> tuple[NetworkValues, NetworkValues]:
        """Return the values of the key `network` at the beginning and the end of the ramp."""
        return (self.network[0].by_scope(), self.network[1].by_scope()) if self.network else ({}, {})

    def at(self, share: float) -> NetworkValues:
        """Return the network conditions at this point of the ramp. `share` is 0 at its beginning and 1 at its end."""
        short = {key: ends for key in ("loss", "delay") if (ends := getattr(self, key)) is not None}
        first, last = (
            overlay({None: {key: ends[number] for key, ends in short.items()}}, end)
            for number, end in enumerate(self._ends())
        )
        return {
            scope: {key: value + (last[scope][key] - value) * share for key, value in keys.items()}
            for scope, keys in first.items()
        }


def _values(end: NetworkValues) -> Iterator[tuple[Scope, str, Any]]:
    return ((scope, key, value) for scope, keys in end.items() for key, value in keys.items())


class RepeatedChange(NetworkDisturbance):
    """A temporary change of the network. Needs at least one key."""

    partition: Groups | None = None
    """Groups of vehicles. Messages between different groups are lost. Vehicles in no group form a further group."""
    delay: DelaySeconds | None = None
    """Delay in mission seconds, 0 to 60."""

    @model_validator(mode="after")
    def _check_values(self) -> "RepeatedChange":
        if all(value is None for value in (self.loss, self.delay, self.partition, self.network)):
            raise ValueError("needs at least one of `loss`, `delay`, `partition` or `network`")
        if self.delay is not None and self.network is not None and self.network.delay is not None:
            raise ValueError("`delay` and `network.delay` are the same setting: leave out one of them")
        return self

    def changes(self) -> NetworkValues:
        values = super().changes()
        return values if self.delay is None else overlay(values, {None: {"delay": self.delay}})


Nemesis = Literal["halves", "isolate", "majorities ring", "bridge", "flapping"]


class Schedule(StrictModel):
    """A gradual or repeated change of the network. Needs exactly one of `ramp`, `repeat` and `nemesis`."""

    ramp: Ramp | None = None
    """A change in equal steps from one value to another. After the end of the ramp, the last value remains."""
    repeat: RepeatedChange | None = None
    """A change that starts every `every_s` and ends after `for_s`."""
    nemesis: Nemesis | None = None
    """A random change that starts every `every_s` and ends after `for_s`. `halves` splits the swarm into two random
    halves. `isolate` separates one vehicle from all others. With `majorities ring`, each vehicle receives messages from
    a different majority, as with the nemesis of Jepsen. `bridge` splits the swarm into two halves, and connects one
    vehicle with both. `flapping` separates one pair of vehicles.
    """
    from_s: MissionSecond = 0.0
    """Mission second of the start."""
    until_s: MissionSecond | None = None
    """Mission second of the end, which must be after `from_s`. By default, it is the end of the mission."""
    every_s: Seconds | None = None
    """Mission seconds between the starts of two changes. Required for `repeat` and `nemesis`. For a ramp, the default
    is 10 s.
    """
    for_s: Seconds | None = None
    """Mission seconds until a change ends, less than `every_s`. Required for `repeat` and `nemesis`, and an error for
    `ramp`.
    """
    seed: int = 0
    """Seed of the random choices of `nemesis`."""

    @model_validator(mode="after")
    def _one_kind(self) -> "Schedule":
        if sum(kind is not None for kind in (self.ramp, self.repeat, self.nemesis)) != 1:
            raise ValueError("needs exactly one of `ramp`, `repeat` or `nemesis`")
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError(f"until_s {self.until_s:g} is not after from_s {self.from_s:g}")
        if self.ramp is not None:
            if self.for_s is not None:
                raise ValueError("for_s belongs to `repeat` and `nemesis`; a ramp ends at until_s: leave out for_s")
        elif self.every_s is None or self.for_s is None:
            raise ValueError("needs `every_s` and `for_s`")
        elif self.for_s >= self.every_s:
            raise ValueError(
                f"for_s {self.for_s:g} is not less than every_s {self.every_s:g}: otherwise the change never ends"
            )
        return self

    def named_vehicles(self) -> Iterator[tuple[str, int]]:
        """Yield each vehicle ID in the schedule, with the key that contains it. IDs in partitions are not included."""
        if self.repeat is not None and self.repeat.network is not None:
            yield from ((f"repeat.network.{key}", vehicle) for key, vehicle in self.repeat.network.named_vehicles())
        for number, end in enumerate((self.ramp.network if self.ramp else None) or ()):
            yield from ((f"ramp.network.{number}.{key}", vehicle) for key, vehicle in end.named_vehicles())

    def steps(self, roster: Sequence[int], end_s: float) -> list[LayerStep]:
        """Return the steps of the schedule in order of time. Raises ValueError if it has more than MAX_STEPS steps."""
        until = end_s if self.until_s is None else self.until_s
        every = self.every_s or 10.0
        if (until - self.from_s) / every > MAX_STEPS:
            raise ValueError(f"every_s {every:g} is more than {MAX_STEPS} steps")
        if self.ramp is not None:
            return _ramp(self.ramp, self.from_s, until, every)
        rng = Random(f"{self.seed}/{self.nemesis}")
        steps: list[LayerStep] = []
        count = 0
        while (at_s := self.from_s + count * every) < until:
            steps.append((at_s, self.nemesis or "repeat", self._layer(roster, rng)))
            steps.append((min(at_s + (self.for_s or 0.0), until), "undone", EMPTY_LAYER))
            count += 1
        return steps

    def _layer(self, roster: Sequence[int], rng: Random) -> TemporaryChange:
        if self.repeat is not None:
            return TemporaryChange(self.repeat.changes(), self.repeat.groups)
        assert self.nemesis is not None, "a schedule is one of three"
        return NEMESES[self.nemesis](rng.sample(list(roster), len(roster)))


def _ramp(ramp: Ramp, from_s: float, until: float, every: float) -> list[LayerStep]:
    count = max(1, round((until - from_s) / every))
    steps: list[LayerStep] = []
    for number in range(count + 1):
        share = number / count
        steps.append((from_s + (until - from_s) * share, "ramp", TemporaryChange(ramp.at(share))))
    return steps


def _halves(shuffled: list[int]) -> TemporaryChange:
    return TemporaryChange(
        partition=(frozenset(shuffled[: len(shuffled) // 2]), frozenset(shuffled[len(shuffled) // 2 :]))
    )


def _isolate(shuffled: list[int]) -> TemporaryChange:
    return TemporaryChange(partition=(frozenset(shuffled[:1]),))


def _majorities_ring(shuffled: list[int]) -> TemporaryChange:
    """Arrange the vehicles in a ring. Return a change in which each vehicle receives messages only from its nearest
    neighbours in the ring. A vehicle and these neighbours form a majority, which is different for each vehicle.
    """
    size = len(shuffled)
    reach = (size // 2 + 1) // 2
    heard = {
        (shuffled[(place + step) % size], shuffled[place]) for place in range(size) for step in range(-reach, reach + 1)
    }
    return TemporaryChange(cut=frozenset((a, b) for a in shuffled for b in shuffled if a != b and (a, b) not in heard))


def _bridge(shuffled: list[int]) -> TemporaryChange:
    _, *rest = shuffled
    left, right = rest[: len(rest) // 2], rest[len(rest) // 2 :]
    return TemporaryChange(cut=frozenset(pair for a in left for b in right for pair in ((a, b), (b, a))))


def _flapping(shuffled: list[int]) -> TemporaryChange:
    pair = shuffled[:2]
    return TemporaryChange(cut=frozenset(((pair[0], pair[1]), (pair[1], pair[0])) if len(pair) == 2 else ()))


NEMESES: dict[Nemesis, Callable[[list[int]], TemporaryChange]] = {
    "halves": _halves,
    "isolate": _isolate,
    "majorities ring": _majorities_ring,
    "bridge": _bridge,
    "flapping": _flapping,
}
"""Nemesis -> function that creates the layer from the vehicles in random order."""

MIN_VEHICLES: dict[Nemesis, int] = {"halves": 2, "isolate": 2, "majorities ring": 4, "bridge": 3, "flapping": 2}
"""Nemesis -> minimum number of vehicles that it needs."""
