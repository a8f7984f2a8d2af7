"""Find the agent of each flight log by comparing times and positions. Also summarise each flight log.

An agent logs positions of its vehicle as events, and the flight log has the same positions more densely. Both come from
the same messages of the autopilot. A moving vehicle therefore passes each place at a known time on the agent's clock,
and at a known time on the clock of the log. If the log belongs to the agent, the difference of these times is the same
for all places. If the log has GPS time, the difference is the error of the agent's clock. Each place votes for a
difference. This method needs no correct clock, and ignores places at which a vehicle stays.

The system ID of a vehicle decides only if positions cannot decide: if the agent logged none, or if the vehicle did not
move. It never assigns a log of another place or day.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Protocol

from harness.field.flight_logs._records import FlightLog, FlightRecord, Position, VehicleLog

MAX_PLACES = 500
"""Maximum number of an agent's positions that are used to find the time difference between the agent and a
flight log.
"""
MAX_ASIDE_M = 3.0
"""Maximum distance in metres of a logged position from the track in the flight log. The distance is small, because
vehicles may fly side by side.
"""
_CELL_DEG = 1e-4
"""Size of a cell of the search grid in degrees of latitude. A cell has a length of about eleven metres."""
_PAUSE_US = 5_000_000
"""Maximum number of microseconds between successive positions of one visit. If a vehicle returns to a place after a
longer time, it makes a new visit.
"""
_MAX_VISIT_US = 20_000_000
"""Maximum duration in microseconds of a visit that is used to find the time difference. A vehicle that is near a place
for longer does not show the time at which it passed the place.
"""
_BIN_US = 1_000_000
_MIN_VOTES = 3
_MIN_SHARE = 0.5
"""Minimum share (0 to 1) of the positions of a moving vehicle that must agree on a time difference between agent and
log.
"""
_SAME_FLIGHT_S = 60.0
_NEAR_M = 1_000.0
_DAY_US = 86_400_000_000
_FIRST_UTC_US = 1_000_000_000_000_000
"""Earliest possible timestamp of a clock that was set. Clocks that were never set show earlier times. A clock that was
set is assumed to be wrong by at most a day, so that a flight along the same path on another day does not match.
"""
_METRES_PER_DEGREE = 111_195.0


class LoggedPosition(Protocol):
    """A position in units of 1e-7 degrees that an agent logged at some time."""

    @property
    def lat_e7(self) -> int: ...
    @property
    def lon_e7(self) -> int: ...


Fixes = Sequence[tuple[int, LoggedPosition]]
"""An agent's positions with their timestamps in microseconds."""


@dataclass(frozen=True)
class MatchedLog:
    """A vehicle in a flight log, and its agent."""

    log: FlightLog
    vehicle: VehicleLog
    agent_id: int | None
    """The ID of the agent, or None if no known agent flew on the vehicle."""
    evidence: str
    """The evidence for the agent. The text completes a sentence such as "is of agent 10 by ..." or "matches no agent:
    ...".
    """
    clock_ahead_s: float | None = None
    """The time on the agent's clock minus GPS time, in seconds, or None if the difference is unknown."""


def match_logs(logs: Iterable[FlightLog], agents: Mapping[int, Fixes]) -> list[MatchedLog]:
    """Find the agent of each vehicle in the flight logs. `agents` contains the logged positions of each agent. If
    several flights follow the path of one agent, the function chooses the flight whose time differs least from the
    agent's own clock.
    """
    matches = [_match(log, vehicle, agents) for log in logs for vehicle in log.vehicles]
    nearest: dict[int, float] = {}
    for match in matches:
        if match.agent_id is not None and match.clock_ahead_s is not None:
            nearest[match.agent_id] = min(nearest.get(match.agent_id, math.inf), match.clock_ahead_s, key=abs)
    return [_other_flight(match, nearest) for match in matches]


def _other_flight(match: MatchedLog, nearest: Mapping[int, float]) -> MatchedLog:
    """Check a match against other logs with the same path, and return it. If the time of another log is closer to the
    agent's clock, the log of this match is from another flight. The returned match then has no agent.
    """
    if match.agent_id is None or match.clock_ahead_s is None:
        return match
    later_s = nearest[match.agent_id] - match.clock_ahead_s
    if abs(later_s) <= _SAME_FLIGHT_S:
        return match
    why = f"it flew the path of agent {match.agent_id} {abs(later_s):.0f} s {'later' if later_s > 0 else 'earlier'}"
    return MatchedLog(match.log, match.vehicle, None, why)


def _match(log: FlightLog, vehicle: VehicleLog, agents: Mapping[int, Fixes]) -> MatchedLog:
    votes = {agent_id: _vote(vehicle.positions, fixes) for agent_id, fixes in agents.items()}
    agreed = [(vote.share, agent_id) for agent_id, vote in votes.items() if vote is not None and vote.agrees]
    if agreed:
        _, agent_id = max(agreed)
        vote = votes[agent_id]
        assert vote is not None
        ahead_s = vote.ahead_us / 1e6 if vote.of_utc else None
        return MatchedLog(log, vehicle, agent_id, f"{vote.agreeing} positions", ahead_s)
    named = vehicle.vehicle
    if named is None:
        return MatchedLog(log, vehicle, None, "its positions are not those of an agent, and it has no system ID")
    if named not in agents:
        return MatchedLog(log, vehicle, None, f"no agent has its system ID {named} or its positions")
    if (contradiction := _contradiction(vehicle, agents[named])) is not None:
        return MatchedLog(log, vehicle, None, f"agent {named} has its system ID, but {contradiction}")
    return MatchedLog(log, vehicle, named, "its system ID")


@dataclass(frozen=True)
class _ClockDifference:
    """The time on the clock of an agent minus the time on the clock of a flight log. If `of_utc` is true, it is the
    time on the agent's clock minus UTC, because the log has GPS time. `voters` is the number of positions that were
    compared, and `agreeing` is the number of those that support this difference.
    """

    ahead_us: float
    agreeing: int
    voters: int
    of_utc: bool

    @property
    def share(self) -> float:
        return self.agreeing / self.voters

    @property
    def agrees(self) -> bool:
        return self.agreeing >= _MIN_VOTES and self.share >= _MIN_SHARE


def _vote(positions: Sequence[Position], fixes: Fixes) -> _ClockDifference | None:
    of_utc = any(position.utc_us is not None for position in positions)
    cells: dict[tuple[int, int], list[tuple[int, Position]]] = defaultdict(list)
    for position in positions:
        at_us = position.utc_us if of_utc else position.at_us
        if at_us is not None:
            cells[_cell(position.lat_deg, position.lon_deg)].append((at_us, position))
    step = len(fixes) // MAX_PLACES + 1
    differences = []
    for timestamp_us, fix in fixes[::step]:
        row, column = _cell(fix.lat_e7 / 1e7, fix.lon_e7 / 1e7)
        near = [at for down in (-1, 0, 1) for right in (-1, 0, 1) for at in cells.get((row + down, column + right), ())]
        if passed := [timestamp_us - at_us for at_us in _visits(near, fix)]:
            differences.append(passed)
    if not differences:
        return None
    clock_is_set = of_utc and fixes[0][0] >= _FIRST_UTC_US
    possible = _DAY_US if clock_is_set else math.inf
    bins = Counter(
        number
        for each in differences
        for number in {round(value / _BIN_US) for value in each if abs(value) <= possible}
    )
    if not bins:
        return None
    best = max(bins, key=lambda number: (bins[number - 1] + bins[number] + bins[number + 1], bins[number]))
    agreeing = [
        min(close, key=lambda value: abs(value - best * _BIN_US))
        for each in differences
        if (close := [value for value in each if abs(round(value / _BIN_US) - best) <= 1])
    ]
    return _ClockDifference(median(agreeing), len(agreeing), len(differences), of_utc)


def _visits(near: list[tuple[int, Position]], fix: LoggedPosition) -> Iterator[int]:
    """Yield the time of each short visit of the vehicle at a place. During a visit, the distance between vehicle and
    place is at most MAX_ASIDE_M.
    """
    near.sort(key=lambda timed: timed[0])
    visit: list[tuple[int, Position]] = []
    for index, timed in enumerate(near):
        visit.append(timed)
        if index + 1 == len(near) or near[index + 1][0] - timed[0] > _PAUSE_US:
            if visit[-1][0] - visit[0][0] <= _MAX_VISIT_US:
                aside_m, at_us = min(_passage(*legs, fix) for legs in pairwise([visit[0], *visit]))
                if aside_m <= MAX_ASIDE_M:
                    yield round(at_us)
            visit = []


def _passage(before: tuple[int, Position], after: tuple[int, Position], fix: LoggedPosition) -> tuple[float, float]:
    """Return the smallest distance in metres between a place and the line between two positions, and the time of this
    smallest distance.
    """
    begin, end = _metres(before[1], fix), _metres(after[1], fix)
    along = (end[0] - begin[0], end[1] - begin[1])
    length = along[0] ** 2 + along[1] ** 2
    share = min(1.0, max(0.0, -(begin[0] * along[0] + begin[1] * along[1]) / length)) if length else 0.0
    aside_m = math.hypot(begin[0] + share * along[0], begin[1] + share * along[1])
    return aside_m, before[0] + share * (after[0] - before[0])


def _metres(position: Position, fix: LoggedPosition) -> tuple[float, float]:
    """Return the distance between a logged position and a position of the vehicle, in metres north and in metres
    east.
    """
    east_deg = (position.lon_deg - fix.lon_e7 / 1e7) * math.cos(math.radians(position.lat_deg))
    return (position.lat_deg - fix.lat_e7 / 1e7) * _METRES_PER_DEGREE, east_deg * _METRES_PER_DEGREE


def _cell(lat_deg: float, lon_deg: float) -> tuple[int, int]:
    return math.floor(lat_deg / _CELL_DEG), math.floor(lon_deg / _CELL_DEG)


def _contradiction(vehicle: VehicleLog, fixes: Fixes) -> str | None:
    """Return the reason why a flight log cannot belong to the agent with these positions. Return None if the log may
    belong to the agent.
    """
    if not vehicle.positions or not fixes:
        return None
    lat_deg = median(position.lat_deg for position in vehicle.positions)
    lon_deg = median(position.lon_deg for position in vehicle.positions)
    north_m = (median(fix.lat_e7 for _, fix in fixes) / 1e7 - lat_deg) * _METRES_PER_DEGREE
    east_m = (median(fix.lon_e7 for _, fix in fixes) / 1e7 - lon_deg) * _METRES_PER_DEGREE
    if (distance_m := math.hypot(north_m, east_m * math.cos(math.radians(lat_deg)))) > _NEAR_M:
        return f"flew {distance_m / 1000:.1f} km away"
    times = [position.utc_us for position in vehicle.positions if position.utc_us is not None]
    logged = [timestamp_us for timestamp_us, _ in fixes if timestamp_us >= _FIRST_UTC_US]
    if times and logged and (min(logged) - max(times) > _DAY_US or min(times) - max(logged) > _DAY_US):
        return "flew on another day"
    return None


LOWEST_FIX = 3
"""GPS_FIX_TYPE of a position in three dimensions."""
HIGHEST_VARIANCE = 1.0
MAX_NAMED_MODES = 8


@dataclass(frozen=True)
class LoggedChange:
    """A change of a vehicle, such as a new flight mode. `at_us` is UTC if the log has GPS time. Otherwise it is the
    time on the log's own clock.
    """

    at_us: int
    agent_id: int | None
    words: str


def in_words(match: MatchedLog) -> str:
    """Return a sentence about a flight log: its agent, its clock, and its records."""
    log, vehicle = match.log, match.vehicle
    owner = (
        f"is of agent {match.agent_id} by {match.evidence}" if match.agent_id else f"matches no agent: {match.evidence}"
    )
    parts = [*_contents(match)]
    clock = ""
    if match.clock_ahead_s is not None:
        clock = f"; the clock of agent {match.agent_id} was {match.clock_ahead_s:+.1f} s off GPS time"
    return f"{log.path}: the {log.kind} log of a {vehicle.type_name} {owner}{clock}; {', '.join(parts) or 'no records'}"


def _contents(match: MatchedLog) -> Iterator[str]:
    log, vehicle = match.log, match.vehicle
    if vehicle.positions:
        yield f"{len(vehicle.positions):,} positions"
    if names := list(dict.fromkeys(mode.name for mode in vehicle.modes)):
        yield "modes " + " ".join(names[:MAX_NAMED_MODES])
    if armed := sum(change.armed for change in vehicle.arming):
        yield "armed once" if armed == 1 else f"armed {armed} times"
    if volts := [battery.voltage_v for battery in vehicle.battery]:
        yield f"battery {max(volts):.1f} to {min(volts):.1f} V"
    if vehicle.gps:
        bad = sum(status.fix < LOWEST_FIX for status in vehicle.gps)
        yield f"{len(vehicle.gps):,} GPS states, {bad:,} without a fix"
    if vehicle.ekf:
        bad = sum(_rejects(status) for status in vehicle.ekf)
        yield f"{len(vehicle.ekf):,} EKF states, {bad:,} with a rejected measurement"
    if log.radio:
        rssi = [radio.rssi for radio in log.radio]
        yield f"radio RSSI {min(rssi)} to {max(rssi)}"
    if vehicle.parameters:
        yield f"{len(vehicle.latest_parameters()):,} parameters"


def changes(match: MatchedLog) -> list[LoggedChange]:
    """Return the changes in order of time: new flight modes, arming, and the beginnings and ends of GPS problems and
    filter problems.
    """
    vehicle, agent_id = match.vehicle, match.agent_id
    found = [
        LoggedChange(_time(mode), agent_id, f"mode {mode.name}" + (f", {mode.failsafe}" if mode.failsafe else ""))
        for mode in vehicle.modes
    ]
    found += [LoggedChange(_time(arm), agent_id, "armed" if arm.armed else "disarmed") for arm in vehicle.arming]
    gps = [(status, status.fix < LOWEST_FIX) for status in vehicle.gps if status.instance == 0]
    found += _turns(gps, agent_id, "GPS without a fix", "GPS has a fix")
    ekf = [(status, _rejects(status)) for status in vehicle.ekf]
    found += _turns(ekf, agent_id, "EKF rejects measurements", "EKF accepts all measurements")
    return sorted(found, key=lambda change: change.at_us)


def _rejects(status: object) -> bool:
    variances = ("velocity_variance", "position_variance", "height_variance", "compass_variance")
    return any(getattr(status, name) > HIGHEST_VARIANCE for name in variances)


def _turns(
    states: Sequence[tuple[FlightRecord, bool]], agent_id: int | None, begins: str, ends: str
) -> Iterator[LoggedChange]:
    if states and states[0][1]:
        yield LoggedChange(_time(states[0][0]), agent_id, begins)
    for (_, before), (record, after) in pairwise(states):
        if before != after:
            yield LoggedChange(_time(record), agent_id, begins if after else ends)


def _time(record: FlightRecord) -> int:
    return record.at_us if record.utc_us is None else record.utc_us
