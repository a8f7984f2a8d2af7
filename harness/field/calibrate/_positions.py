"""Find the positions of the vehicles over time in `tracks.jsonl` of a run, in flight logs, or in logged events.
Estimate the path loss exponent from these positions and the reported signal strengths.

For each vehicle, the first of these sources that exists is used. A flight log belongs to the agent with the vehicle's
MAVLink system ID. Only records with GPS time are used, because the clocks of the autopilot and of the computer have no
relation to mission time. Between two known positions, a straight path is assumed. In gaps longer than MAX_GAP_S, the
position is unknown.

Telemetry radios report signal strengths (RADIO_STATUS). The estimate assumes that the ground station is at the place
where the vehicle took off. The signal strength falls by 10 * exponent dB when the distance grows by a factor of ten.
The unit of SiK radios is 1.9 counts per dB (SiK, Firmware/radio/radio.c). The interval comes from the jackknife over
minutes, because neighbouring samples have the same shadowing.
"""

import math
from bisect import bisect_right
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from harness.archive.bounded_file import BoundedFile
from harness.archive.tracks import TRACKS_FILE, PositionFix, between, read_tracks
from harness.errors import FieldError
from harness.field.calibrate._delivery_model import ConfidenceInterval, student
from harness.field.flight_logs import FlightLog, flight_log_kind, read_flight_log
from harness.field.ingest import Flight
from harness.report.logbook.positions import track_of
from ucp.events import LoggableEvent, MalformedEventsError, decode_events

MAX_GAP_S = 30.0
_MARGIN_S = 5.0
_METRES_PER_DEGREE = 111_195.0
_FARTHEST_M = 200_000.0
_BEGINNING_BYTES = 4096

Place = tuple[float, float, float, float]
"""A known position: mission second, degrees north, degrees east, metres above mean sea level."""


@dataclass
class Positions:
    """The paths of the vehicles in metres. `sources` names the source of each path."""

    tracks: dict[int, list[PositionFix]]
    sources: dict[int, str]
    logs: list[FlightLog] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def at(self, vehicle: int, at_s: float) -> PositionFix | None:
        """Return the position of a vehicle at a mission second. Return None if the position is unknown."""
        track = self.tracks.get(vehicle)
        if not track or not track[0].at_s - _MARGIN_S <= at_s <= track[-1].at_s + _MARGIN_S:
            return None
        after = bisect_right(track, at_s, key=lambda fix: fix.at_s)
        if after == 0 or after == len(track):
            return track[0 if after == 0 else -1]
        if track[after].at_s - track[after - 1].at_s > MAX_GAP_S:
            return None
        return between(track[after - 1], track[after], at_s)

    def distance_m(self, one: int, other: int, at_s: float) -> float | None:
        """Return the three-dimensional distance between two vehicles in metres. Return None if the position of either
        vehicle is unknown.
        """
        first, second = self.at(one, at_s), self.at(other, at_s)
        if first is None or second is None:
            return None
        return math.dist(first[1:], second[1:])


def find_positions(paths: Iterable[Path], flight: Flight, vehicles: Collection[int], epoch_us: int) -> Positions:
    """Return the positions of `vehicles` over time. A vehicle without any known position has no path."""
    positions = Positions({}, {})
    log_paths: list[Path] = []
    for path in _files(paths):
        if path.name == TRACKS_FILE and not positions.tracks:
            tracks = read_tracks(path, vehicles)
            positions.problems += tracks.problems
            positions.tracks |= tracks.by_vehicle
            positions.sources |= dict.fromkeys(tracks.by_vehicle, TRACKS_FILE)
        elif path.suffix.lower() in (".bin", ".tlog") and _is_log(path):
            log_paths.append(path)
    missing = set(vehicles) - positions.tracks.keys()
    places: dict[int, list[Place]] = {}
    for path in log_paths:
        _add_log(positions, path, missing, epoch_us, places)
    _add_events(positions, flight, missing - places.keys(), epoch_us, places)
    _project(positions, places)
    return positions


def _files(paths: Iterable[Path]) -> list[Path]:
    return sorted(
        {file for path in paths for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file()}
    )


def _is_log(path: Path) -> bool:
    try:
        with BoundedFile(path) as file:
            return flight_log_kind(path, file.peek(_BEGINNING_BYTES)[:_BEGINNING_BYTES]) is not None
    except OSError:
        return False


def _add_log(
    positions: Positions, path: Path, vehicles: Collection[int], epoch_us: int, places: dict[int, list[Place]]
) -> None:
    try:
        log = read_flight_log(path)
    except FieldError as error:
        positions.problems.append(str(error))
        return
    positions.logs.append(log)
    positions.problems += [f"{path}: {problem}" for problem in log.problems]
    for vehicle in log.vehicles:
        if vehicle.vehicle is None:
            positions.problems.append(
                f"{path}: it does not have the vehicle's system ID, so its positions are not used"
            )
        elif vehicle.vehicle in vehicles and vehicle.vehicle not in places:
            known = [
                ((position.utc_us - epoch_us) / 1e6, *position[2:5])
                for position in vehicle.positions
                if position.utc_us is not None
            ]
            if len(known) < len(vehicle.positions):
                left_out = len(vehicle.positions) - len(known)
                positions.problems.append(f"{path}: {left_out} positions have no GPS time and are not used")
            if known:
                places[vehicle.vehicle] = known
                positions.sources[vehicle.vehicle] = path.name


def _add_events(
    positions: Positions, flight: Flight, vehicles: Collection[int], epoch_us: int, places: dict[int, list[Place]]
) -> None:
    logged: dict[int, dict[tuple[int, bytes], LoggableEvent]] = {}
    for export in flight.exports.values():
        for block in export.blocks():
            try:
                for event in decode_events(block.event_bytes):
                    logged.setdefault(block.agent_id, {})[event.timestamp_us, event.data] = event
            except MalformedEventsError:
                continue
    for vehicle in vehicles:
        track = track_of(vehicle, ((event, "") for event in logged.get(vehicle, {}).values()))
        if track.fixes:
            places[vehicle] = [
                ((at_us - epoch_us) / 1e6, position.lat_e7 / 1e7, position.lon_e7 / 1e7, position.alt_mm / 1000)
                for at_us, position in track.fixes
            ]
            positions.sources[vehicle] = "logged events"


def _project(positions: Positions, places: dict[int, list[Place]]) -> None:
    """Convert degrees to metres north and east of the median position."""
    if not places:
        return
    lat, lon = (_median([place[axis] for each in places.values() for place in each]) for axis in (1, 2))
    east = _METRES_PER_DEGREE * max(0.01, math.cos(math.radians(lat)))
    for vehicle, track in places.items():
        fixes = [
            PositionFix(at_s, (north - lat) * _METRES_PER_DEGREE, ((there - lon + 180) % 360 - 180) * east, alt_m)
            for at_s, north, there, alt_m in sorted(track)
        ]
        near = [fix for fix in fixes if math.hypot(fix.north_m, fix.east_m) <= _FARTHEST_M]
        if len(near) < len(fixes):
            positions.problems.append(
                f"vehicle {vehicle}: {len(fixes) - len(near)} positions are more than {_FARTHEST_M / 1000:.0f} km away "
                "from the others and are left out"
            )
        if near:
            positions.tracks[vehicle] = near


def _median(values: Sequence[float]) -> float:
    return sorted(values)[len(values) // 2]


_COUNTS_PER_DB = 1.9
_MIN_SAMPLES, _MIN_MINUTES, _MIN_RATIO = 30, 4, 3.0
_MIN_DISTANCE_M = 10.0
_PLAUSIBLE = (1.0, 6.0)

Sample = tuple[float, float, int]
"""A signal strength measurement: ln(distance), signal strength in dB, and the index of the minute in which it was
measured.
"""


@dataclass(frozen=True)
class SignalFit:
    """The estimated path loss exponent with its confidence interval, from `samples` signal strengths."""

    exponent: float
    interval: ConfidenceInterval
    samples: int


def fit_signal(positions: Positions) -> SignalFit | None:
    """Estimate the path loss exponent from the signal strengths in all logs. Return None if the logs do not determine
    it.
    """
    samples = [sample for number, log in enumerate(positions.logs) for sample in _samples(positions, number)]
    minutes = sorted({minute for _, _, minute in samples})
    if len(samples) < _MIN_SAMPLES or len(minutes) < _MIN_MINUTES:
        return None
    if max(samples)[0] - min(samples)[0] < math.log(_MIN_RATIO):
        return None
    slope = _exponent(samples)
    without = [_exponent([sample for sample in samples if sample[2] != minute]) for minute in minutes]
    variance = sum((each - slope) ** 2 for each in without) * (len(minutes) - 1) / len(minutes)
    half = student(len(minutes) - 1) * math.sqrt(variance)
    if not _PLAUSIBLE[0] <= slope <= _PLAUSIBLE[1]:
        return None
    return SignalFit(slope, ConfidenceInterval(slope - half, slope + half), len(samples))


def _samples(positions: Positions, number: int) -> list[Sample]:
    log = positions.logs[number]
    if len(log.vehicles) != 1 or not (track := log.vehicles[0].positions):
        return []
    home, place, samples = track[0], 0, []
    for status in log.radio:
        while place + 1 < len(track) and track[place + 1].at_us <= status.at_us:
            place += 1
        position = track[place]
        if not status.rssi or abs(position.at_us - status.at_us) > 2_000_000:
            continue
        distance_m = math.hypot(
            (position.lat_deg - home.lat_deg) * _METRES_PER_DEGREE,
            (position.lon_deg - home.lon_deg) * _METRES_PER_DEGREE * math.cos(math.radians(home.lat_deg)),
            position.alt_m - home.alt_m,
        )
        if distance_m >= _MIN_DISTANCE_M:
            minute = number * 1_000_000 + status.at_us // 60_000_000 % 1_000_000
            samples.append((math.log(distance_m), status.rssi / _COUNTS_PER_DB, minute))
    return samples


def _exponent(samples: Sequence[Sample]) -> float:
    mean_x = sum(x for x, _, _ in samples) / len(samples)
    mean_y = sum(y for _, y, _ in samples) / len(samples)
    slope = sum((x - mean_x) * (y - mean_y) for x, y, _ in samples) / sum((x - mean_x) ** 2 for x, _, _ in samples)
    return -slope * math.log(10) / 10
