"""Where vehicles were by the run's own record, for maps: in virtual time events say nothing of it."""

from collections.abc import Sequence
from typing import NamedTuple

from harness.archive.run_record import RunRecord
from harness.archive.tracks import Fix, Tracks
from harness.report.logbook.positions import Track
from sitl.vehicle import Home


class Place(NamedTuple):
    """1e-7 degrees, and millimetres above mean sea level."""

    lat_e7: int
    lon_e7: int
    alt_mm: int


def flown(record: RunRecord, recorded: Tracks) -> list[Track]:
    """A track without events for each vehicle that is on record, on the field of the scenario's home."""
    if record.scenario is None:
        return []
    home = record.scenario.vehicles.field
    return [_track(vehicle, fixes, home) for vehicle, fixes in recorded.by_vehicle.items()]


def _track(vehicle: int, fixes: Sequence[Fix], home: Home) -> Track:
    return Track(vehicle, [], [(round(fix.at_s * 1e6), _place(fix, home)) for fix in fixes])


def _place(fix: Fix, home: Home) -> Place:
    there = home.offset(fix.north_m, fix.east_m)
    return Place(round(there.lat_deg * 1e7), round(there.lon_deg * 1e7), round((there.alt_m + fix.up_m) * 1e3))
