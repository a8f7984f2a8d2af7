"""What happened in a run, each thing with its time in nanoseconds since the Unix epoch."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from harness.archive.connectivity import Components, Link
from harness.archive.history import Message, Reconcile, Vote
from harness.archive.replication import Replication
from ucp.trace import HandlerRun

Level = Literal["info", "warning", "error"]


Metres = tuple[float, float, float]
"""East, north and up."""


class Place(NamedTuple):
    """Degrees, and metres above mean sea level."""

    lat_deg: float
    lon_deg: float
    alt_m: float


@dataclass(frozen=True, slots=True)
class Position:
    """Where a vehicle was, seen from the middle of the field; `place` is None if unknown."""

    at_ns: int
    vehicle: int
    metres: Metres
    place: Place | None


@dataclass(frozen=True, slots=True)
class LossesChanged:
    """From now on these links lose so much, 0..1; a link is from a sender to a receiver, others are as they were."""

    at_ns: int
    losses: Mapping[Link, float]


@dataclass(frozen=True, slots=True)
class NetworkChanged:
    """Who reaches whom, the largest group first, and what the links that there are lose."""

    at_ns: int
    groups: Components
    mean_loss: float
    worst_loss: float


@dataclass(frozen=True, slots=True)
class Step:
    """A handler ran."""

    at_ns: int
    agent: int
    run: HandlerRun


@dataclass(frozen=True, slots=True)
class Refused:
    """An agent dropped a datagram, and gave it to no handler."""

    at_ns: int
    agent: int
    reason: str


@dataclass(frozen=True, slots=True)
class Broadcast:
    """A message, when it was sent."""

    at_ns: int
    message: Message


@dataclass(frozen=True, slots=True)
class Voted:
    """A vote came to its end."""

    at_ns: int
    vote: Vote


@dataclass(frozen=True, slots=True)
class Reconciled:
    """A reconcile came to its end, or was cut short."""

    at_ns: int
    reconcile: Reconcile


@dataclass(frozen=True, slots=True)
class Spread:
    """How far the data had spread."""

    at_ns: int
    replication: Replication


@dataclass(frozen=True, slots=True)
class Telemetry:
    """A MAVLink message of a vehicle, as pymavlink decoded it."""

    at_ns: int
    vehicle: int
    message: Any


@dataclass(frozen=True, slots=True)
class Said:
    """A line of a log, a fault, a change of the network, a verdict: `source` says whose."""

    at_ns: int
    level: Level
    source: str
    text: str


Sample = (
    Position
    | LossesChanged
    | NetworkChanged
    | Step
    | Refused
    | Broadcast
    | Voted
    | Reconciled
    | Spread
    | Telemetry
    | Said
)
