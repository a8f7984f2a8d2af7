"""Samples of a run, each with its time in nanoseconds since the Unix epoch.

Mission second 0 is the epoch that the agents were given: wall time, and in virtual time the Unix epoch itself. At a
speedup mission time runs ahead of the wall clock, as the timestamps of blocks do.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal, NamedTuple

from harness.archive.connectivity import Components, Link
from harness.archive.history import LATEST_S, Message, Reconcile, Vote
from harness.archive.replication import Replication
from harness.archive.run_record import RunRecord
from harness.archive.traces import Header
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


MAX_EPOCH_S = 2**31 - 1 - round(LATEST_S)
"""A later mission would end when ROS has no times left, in 2038."""
MAX_SPEEDUP = 1000.0
_NS = 1_000_000_000


@dataclass(frozen=True)
class MissionTime:
    """`epoch_ns` is mission second 0; that of an agent whose clock was set otherwise is in `by_agent`."""

    epoch_ns: int
    speedup: float
    by_agent: Mapping[int, int]

    def at(self, mission_s: float, agent: int | None = None) -> int:
        """The time of a mission second, by the agent's clock if one is named; never before 1970."""
        epoch_ns = self.epoch_ns if agent is None else self.by_agent.get(agent, self.epoch_ns)
        return max(0, epoch_ns + round(mission_s * _NS))

    def mission_s(self, at_ns: int) -> float:
        """The mission second of a time."""
        return (at_ns - self.epoch_ns) / _NS

    def of_wall(self, wall_s: float) -> int | None:
        """The time of what the wall clock timed, in seconds since the Unix epoch; None if no mission is as long."""
        mission_s = (wall_s - self.epoch_ns / _NS) * self.speedup
        return self.at(mission_s) if abs(mission_s) <= LATEST_S else None

    def of_timestamp(self, timestamp_us: int) -> int | None:
        """The time of a block's or event's timestamp; None if no mission is as long."""
        at_ns = timestamp_us * 1000
        return at_ns if abs(self.mission_s(at_ns)) <= LATEST_S else None


def mission_time(headers: Mapping[int, Header], record: RunRecord, problems: list[str]) -> MissionTime:
    """By the headers of the traces, else by the record; a sentence on each clock that cannot be is added."""
    epochs = {}
    for agent, header in headers.items():
        epoch_us = header.clock.get("epoch_us")
        if type(epoch_us) is int and 0 <= epoch_us <= MAX_EPOCH_S * 1_000_000:
            epochs[agent] = epoch_us * 1000
        else:
            problems.append(
                f"agent {agent}: the start of its mission is not in its trace; the start of the other agents is used"
            )
    epoch_ns = Counter(epochs.values()).most_common(1)[0][0] if epochs else _began(record)
    return MissionTime(epoch_ns, _speedup(headers, record), epochs)


def _speedup(headers: Mapping[int, Header], record: RunRecord) -> float:
    told = [header.clock.get("speedup") for header in headers.values()]
    asked = [record.scenario.speedup] if record.scenario else []
    possible = (
        float(speedup) for speedup in (*told, *asked) if isinstance(speedup, int | float) and 0 < speedup <= MAX_SPEEDUP
    )
    return next(possible, 1.0)


def _began(record: RunRecord) -> int:
    """When the run was started: of one without a trace nothing is as near its mission's start."""
    try:
        began = datetime.fromisoformat(record.started_at or "")
    except ValueError:
        return 0
    seconds = round((began if began.tzinfo else began.replace(tzinfo=UTC)).timestamp())
    return seconds * _NS if 0 <= seconds <= MAX_EPOCH_S and record.backend != "sim" else 0
