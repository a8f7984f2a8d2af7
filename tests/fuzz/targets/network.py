"""Fuzz target: network.jsonl, the record of network conditions and faults."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.archive.connectivity import NETWORK_FILE, read_connectivity
from tests.fuzz.finding import sound
from tests.harness.field.flights import flown as fly


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / NETWORK_FILE
        path.write_bytes(data)
        network = read_connectivity(path, (1, 2, 3))
        for problem in network.problems:
            sound(problem)
        for at_s in (0.0, 50.0, 1e9):
            _ = network.links(at_s), network.airborne_intervals(2, at_s)


def seeds(flown: Path) -> Iterator[bytes]:
    timeline = [
        {"at_s": 20, "partition": [[1, 2], [3]]},
        {"at_s": 30, "kill": [2]},
        {"at_s": 40, "restart": [2]},
        {"at_s": 50, "heal": True},
        {"at_s": 60, "network": {"links": [{"from": 1, "to": 2, "loss": 0.9}]}},
    ]
    with TemporaryDirectory() as directory:
        run = fly(Path(directory) / "run", duration_s=80, timeline=timeline)
        yield (run / NETWORK_FILE).read_bytes()
