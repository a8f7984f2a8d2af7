"""Write flight paths, and the network conditions that follow from them, for tests of the map."""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from harness.archive.directory import TRACKS_FILE
from harness.play._radio_range import RadioRange
from harness.scenario import Scenario
from harness.scenario.changes import NetworkChange, timeline_of
from netem.radio import Place

Way = Callable[[float], tuple[float, float]]
"""The position of a vehicle at each mission second, in metres north and metres east."""


def still(north_m: float, east_m: float) -> Way:
    return lambda at_s: (north_m, east_m)


def split_and_rejoin(vehicle: int) -> Way:
    """Return the position of a vehicle in a flight. The vehicles are together for a minute, in two groups for two
    minutes, and together again.
    """
    side = -1 if vehicle <= 3 else 1

    def way(at_s: float) -> tuple[float, float]:
        apart = 300 * (1 - math.cos(math.pi * min(max(at_s - 60, 0), 480) / 240)) / 2
        turn = at_s / 9 + vehicle
        return 60 * vehicle + 25 * math.sin(turn), side * apart + 25 * math.cos(turn)

    return way


def write_flight(run_dir: Path, scenario: Scenario, ways: Mapping[int, Way], seconds: int) -> None:
    """Record the positions of vehicles once per second, and apply the scenario's network."""
    reach = RadioRange(scenario)
    changes = timeline_of(scenario)
    lines: list[dict[str, Any]] = []
    tracks = []
    for at_s in range(seconds + 1):
        while changes and changes[0].at_s <= at_s:
            change = changes.pop(0)
            if isinstance(change, NetworkChange):
                asked = reach.change_timeline(change)
                lines.append({**asked.to_json(change.at_s), "asked": change.conditions.to_json()})
            else:
                lines.append(change.to_json(change.at_s))
        places = {vehicle: Place(*way(at_s), 20.0) for vehicle, way in ways.items()}
        tracks.append({"at_s": float(at_s), "places": {str(one): place.to_json() for one, place in places.items()}})
        if moved := reach.move(float(at_s), places):
            lines.append(moved.to_json(moved.at_s))
    write_lines(run_dir / TRACKS_FILE, tracks)
    write_lines(run_dir / "network.jsonl", lines)


def write_lines(path: Path, documents: Iterable[Mapping[str, Any]]) -> None:
    path.write_text("".join(json.dumps(document) + "\n" for document in documents))
