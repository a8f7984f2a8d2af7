"""Define the types of the recorded values of a run. Each value has a time in nanoseconds since the Unix epoch.

Mission second 0 is the epoch that the agents received: wall time, or 0 in virtual time. With a speedup, mission time
runs faster than wall time. The timestamps of blocks run faster in the same way.

`CurrentLinks` draws lines for the radio links between moving vehicles. The lines are updated after vehicles have moved,
at most once per mission second. The number of links grows with the square of the number of vehicles, so the lines of
large swarms are updated less often.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import combinations
from typing import Any, Literal, NamedTuple

from harness.archive.connectivity import Components, Link
from harness.archive.history import LATEST_S, AgentReconcile, AgentVote, BroadcastMessage
from harness.archive.replication import ReplicationFigures
from harness.archive.run_record import RunRecord
from harness.archive.traces import TraceHeader
from ucp.trace import HandlerRun

Level = Literal["info", "warning", "error"]


Metres = tuple[float, float, float]
"""A position in metres: east, north and up."""


class EarthPosition(NamedTuple):
    """A position on Earth: latitude and longitude in degrees, and altitude in metres above mean sea level."""

    lat_deg: float
    lon_deg: float
    alt_m: float


@dataclass(frozen=True, slots=True)
class FieldPosition:
    """The position of one vehicle at one time."""

    at_ns: int
    vehicle: int
    metres: Metres
    """Metres east, north and up from the centre of the field."""
    place: EarthPosition | None
    """The position on Earth, or None if the location of the field is unknown."""


@dataclass(frozen=True, slots=True)
class LossSample:
    """A change of loss rates. `losses` maps pairs (sender, receiver) to loss rates. The other pairs keep their loss
    rates.
    """

    at_ns: int
    losses: Mapping[Link, float]


@dataclass(frozen=True, slots=True)
class NetworkSample:
    """A change of the network. It contains the groups of connected vehicles (the largest is first), and the loss rates
    of the links.
    """

    at_ns: int
    groups: Components
    mean_loss: float
    worst_loss: float


@dataclass(frozen=True, slots=True)
class HandlerRunSample:
    """A handler run of an agent."""

    at_ns: int
    agent: int
    run: HandlerRun


@dataclass(frozen=True, slots=True)
class DropSample:
    """A datagram that an agent dropped."""

    at_ns: int
    agent: int
    reason: str


@dataclass(frozen=True, slots=True)
class MessageSample:
    """A message, at the time at which it was sent."""

    at_ns: int
    message: BroadcastMessage


@dataclass(frozen=True, slots=True)
class VoteSample:
    """A vote, at the time at which it ended."""

    at_ns: int
    vote: AgentVote


@dataclass(frozen=True, slots=True)
class ReconcileSample:
    """A reconcile, at the time at which it ended or was interrupted."""

    at_ns: int
    reconcile: AgentReconcile


@dataclass(frozen=True, slots=True)
class ReplicationSample:
    """The numbers of copies of blocks during an interval in which they did not change."""

    at_ns: int
    replication: ReplicationFigures


@dataclass(frozen=True, slots=True)
class TelemetrySample:
    """A MAVLink message of a vehicle, which pymavlink decoded."""

    at_ns: int
    vehicle: int
    message: Any


@dataclass(frozen=True, slots=True)
class LogLine:
    """A line of text with a time: a line of a log file, a fault, a network change or a verdict. `source` is the name of
    the log file, or a word for the part of the run that the line describes.
    """

    at_ns: int
    level: Level
    source: str
    text: str


Sample = (
    FieldPosition
    | LossSample
    | NetworkSample
    | HandlerRunSample
    | DropSample
    | MessageSample
    | VoteSample
    | ReconcileSample
    | ReplicationSample
    | TelemetrySample
    | LogLine
)


MAX_EPOCH_S = 2**31 - 1 - round(LATEST_S)
"""Latest start of a mission. ROS can represent times until 2038, and a mission that starts later could exceed this
limit.
"""
MAX_SPEEDUP = 1000.0
_NS = 1_000_000_000


@dataclass(frozen=True)
class MissionTime:
    """The clock of the mission. It converts between mission seconds and time since the Unix epoch."""

    epoch_ns: int
    """The time of mission second 0, in nanoseconds since the Unix epoch."""
    speedup: float
    by_agent: Mapping[int, int]
    """The time of mission second 0 on the clock of an agent, by agent ID. Only agents whose clock differs from the
    clock of the mission are included.
    """

    def at(self, mission_s: float, agent: int | None = None) -> int:
        """Convert a mission second to nanoseconds since the Unix epoch. If `agent` is given, use the clock of this
        agent. The result is never negative.
        """
        epoch_ns = self.epoch_ns if agent is None else self.by_agent.get(agent, self.epoch_ns)
        return max(0, epoch_ns + round(mission_s * _NS))

    def mission_s(self, at_ns: int) -> float:
        """Convert a time since the Unix epoch to a mission second."""
        return (at_ns - self.epoch_ns) / _NS

    def of_wall(self, wall_s: float) -> int | None:
        """Convert wall time (Unix seconds) to a time on the clock of the mission, which runs `speedup` times as fast.
        Return None if the result is far outside the mission.
        """
        mission_s = (wall_s - self.epoch_ns / _NS) * self.speedup
        return self.at(mission_s) if abs(mission_s) <= LATEST_S else None

    def of_timestamp(self, timestamp_us: int) -> int | None:
        """Convert the timestamp of a block or an event to a time on the clock of the mission. Return None if the result
        is far outside the mission.
        """
        at_ns = timestamp_us * 1000
        return at_ns if abs(self.mission_s(at_ns)) <= LATEST_S else None


def mission_time(headers: Mapping[int, TraceHeader], record: RunRecord, problems: list[str]) -> MissionTime:
    """Return the clock of the mission. The clock starts at the time that most headers of traces contain. If no header
    contains a valid time, the clock starts at the time in run.json. Add a sentence to `problems` for each invalid
    header.
    """
    epochs = {}
    for agent, header in headers.items():
        epoch_us = header.clock.get("epoch_us")
        if type(epoch_us) is int and 0 <= epoch_us <= MAX_EPOCH_S * 1_000_000:
            epochs[agent] = epoch_us * 1000
        else:
            problems.append(
                f"agent {agent}: the start of its mission is not in its trace; the start of the other agents is used"
            )
    epoch_ns = Counter(epochs.values()).most_common(1)[0][0] if epochs else _start_ns(record)
    return MissionTime(epoch_ns, _speedup(headers, record), epochs)


def _speedup(headers: Mapping[int, TraceHeader], record: RunRecord) -> float:
    recorded = [header.clock.get("speedup") for header in headers.values()]
    planned = [record.scenario.speedup] if record.scenario else []
    possible = (
        float(speedup)
        for speedup in (*recorded, *planned)
        if isinstance(speedup, int | float) and 0 < speedup <= MAX_SPEEDUP
    )
    return next(possible, 1.0)


def _start_ns(record: RunRecord) -> int:
    """Return the time at which the run started, in nanoseconds since the Unix epoch. The caller uses it if the start of
    the mission is unknown. Return 0 in virtual time.
    """
    try:
        start = datetime.fromisoformat(record.started_at or "")
    except ValueError:
        return 0
    seconds = round((start if start.tzinfo else start.replace(tzinfo=UTC)).timestamp())
    return seconds * _NS if 0 <= seconds <= MAX_EPOCH_S and record.backend != "sim" else 0


FIELD = "field"
"""Name of the coordinate frame of the field: x is east, y north and z up, in metres from the centre of the field."""
PAIRS_A_SECOND = 100


def vehicle_frame(vehicle: int) -> str:
    """Return the name of the coordinate frame that moves with the vehicle."""
    return f"vehicle_{vehicle}"


class LinkLine(NamedTuple):
    """A line that represents the link between two vehicles. `loss` is the larger loss rate of the two directions, and
    is below 1.
    """

    low: Metres
    high: Metres
    loss: float

    @property
    def colour(self) -> dict[str, float]:
        """The colour of the link as red, green, blue and opacity, each from 0 to 1. Green means no loss, and faint red
        means a high loss rate.
        """
        return {"r": self.loss, "g": 1.0 - self.loss, "b": 0.1, "a": 1.0 - 0.7 * self.loss}


class CurrentLinks:
    """The current positions of the vehicles, and the current loss rates of the links between them."""

    def __init__(self) -> None:
        self.losses: dict[Link, float] = {}
        self._places: dict[int, Metres] = {}
        self._drawn_ns: int | None = None
        self._moved_ns = -1

    def move(self, position: FieldPosition) -> list[LinkLine] | None:
        """Store a new position. If the links are due to be drawn, return their lines, otherwise None.

        All vehicles report their positions at the same times. A position with a later time therefore means that all
        positions of the earlier time are known. The returned lines connect these earlier positions.
        """
        at_ns = position.at_ns
        due = at_ns > self._moved_ns and self._are_due(at_ns)
        lines = self._lines() if due else None
        self._drawn_ns = at_ns if due else self._drawn_ns
        self._places[position.vehicle] = position.metres
        self._moved_ns = at_ns
        return lines

    def _are_due(self, at_ns: int) -> bool:
        pairs = len(self._places) * (len(self._places) - 1) // 2
        every_ns = max(1.0, pairs / PAIRS_A_SECOND) * 1e9
        return bool(self.losses and pairs) and (self._drawn_ns is None or at_ns - self._drawn_ns >= every_ns)

    def _lines(self) -> list[LinkLine]:
        lines = []
        for low, high in combinations(sorted(self._places), 2):
            loss = max(self.losses.get((low, high), 1.0), self.losses.get((high, low), 1.0))
            if loss < 1.0:
                lines.append(LinkLine(self._places[low], self._places[high], loss))
        return lines
