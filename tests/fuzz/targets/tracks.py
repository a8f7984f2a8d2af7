"""Fuzz target: tracks.jsonl, the positions of the vehicles."""

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.archive.tracks import TRACKS_FILE, read_tracks
from tests.fuzz.finding import require, sound

LINES = 4


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / TRACKS_FILE
        path.write_bytes(data)
        tracks = read_tracks(path, (1, 2, 3))
        for problem in tracks.problems:
            sound(problem)
        for vehicle, fixes in tracks.by_vehicle.items():
            for fix in fixes:
                require(tracks.at(vehicle, fix.at_s).at_s == fix.at_s, "it was somewhere else")
                tracks.at(vehicle, fix.at_s + 0.5)


def seeds(flown: Path) -> Iterator[bytes]:
    lines = ({"at_s": second, "places": {1: [second, 2.5, 10], 2: [0, 0, 0]}} for second in range(LINES))
    yield "".join(json.dumps(line) + "\n" for line in lines).encode()
