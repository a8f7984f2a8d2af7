"""Summarise a flight log in one sentence, and list the changes over time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from harness.field.flight_logs._matching import MatchedLog
from harness.field.flight_logs._records import FlightRecord
from harness.present import text

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


def change_in_words(change: LoggedChange) -> tuple[str, str, str]:
    """Return the time, the agent and the kind of the change, each as text."""
    return text.moment(change.at_us), "" if change.agent_id is None else str(change.agent_id), change.words
