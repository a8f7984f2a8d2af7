"""Read the positions of the vehicles over mission time from `tracks.jsonl`, in metres from the centre of the field."""

from bisect import bisect_right
from collections.abc import Collection
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from harness.archive.bounded_file import JsonLines

TRACKS_FILE = "tracks.jsonl"

MissionSeconds = Annotated[float, Field(ge=0, le=1e9)]
Metres = Annotated[float, Field(ge=-1e6, le=1e6)]
"""A coordinate in metres. Coordinates of more than 1000 km are invalid."""


class PositionFix(NamedTuple):
    """The position of a vehicle at mission second `at_s`."""

    at_s: float
    north_m: float
    east_m: float
    up_m: float = 0.0


@dataclass(frozen=True)
class VehicleTracks:
    """The positions of each vehicle in order of time. Each vehicle has at least one position.

    `problems` has a sentence for each unreadable part.
    """

    by_vehicle: dict[int, list[PositionFix]]
    problems: list[str]

    def at(self, vehicle: int, at_s: float) -> PositionFix:
        """Return the position of a vehicle at any second, interpolated between two recorded positions."""
        fixes = self.by_vehicle[vehicle]
        position = bisect_right(fixes, at_s, key=attrgetter("at_s"))
        before, after = fixes[max(position - 1, 0)], fixes[min(position, len(fixes) - 1)]
        return between(before, after, at_s) if before.at_s < at_s < after.at_s else before._replace(at_s=at_s)


def between(before: PositionFix, after: PositionFix, at_s: float) -> PositionFix:
    """Return the position of a vehicle between two known positions. The function assumes that the vehicle flies
    straight at constant speed.
    """
    share = (at_s - before.at_s) / (after.at_s - before.at_s)
    return PositionFix(
        at_s,
        before.north_m + share * (after.north_m - before.north_m),
        before.east_m + share * (after.east_m - before.east_m),
        before.up_m + share * (after.up_m - before.up_m),
    )


class TrackLine(BaseModel):
    """A line of `tracks.jsonl`: the positions of vehicles at one moment, in metres north, east and up."""

    model_config = ConfigDict(strict=True, defer_build=True)

    at_s: MissionSeconds
    places: dict[int, tuple[Metres, Metres, Metres]]


def read_tracks(path: Path | None, vehicles: Collection[int]) -> VehicleTracks:
    """Read the positions of `vehicles`. Lines about other vehicles are omitted."""
    lines = JsonLines(path, TrackLine)
    fixes: dict[int, list[PositionFix]] = {}
    known = set(vehicles)
    for line in lines:
        if not line.places.keys() <= known:
            lines.leave_out()
            continue
        for vehicle, place in line.places.items():
            fixes.setdefault(vehicle, []).append(PositionFix(line.at_s, *place))
    for track in fixes.values():
        track.sort(key=attrgetter("at_s"))
    return VehicleTracks(dict(sorted(fixes.items())), lines.problems())
