"""Measure the delay that a remote agent adds: `python -m benchmarks.remote_delay [--rounds R] [--json]`.

Each round plays one mission with local agents and one remote agent, which joins over a local link. The packet captures
of the run show when a Block Add Request reaches a vehicle's port of the switch, and when the answer arrives at this
port. The benchmark compares this answer time of the remote agent with that of the local agents. Half of the difference
is the added delay in one direction. Needs root, because the far end opens /dev/net/tun.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.rounds import Spread, show
from harness.archive.packets.capture_files import capture_files, read_captures
from harness.archive.packets.pcap import INBOUND, OUTBOUND
from harness.play.remote.secret_file import create_secret
from harness.run.run import run
from harness.scenario.load import parse

REMOTE = 2
ADDRESS = "127.0.0.1:14700"
FORMS = {"local_ms": ".3f", "remote_ms": ".3f", "added_ms": ".3f", "ping_ms": ".3f"}


def answer_times(directory: Path) -> Iterator[tuple[int, float]]:
    """Yield the ID of each vehicle that answered a Block Add Request, with the answer time in milliseconds.

    Both times are taken at the vehicle's port of the switch.
    """
    captures = read_captures(capture_files([directory]))
    of_vehicle = {capture.number: capture for capture in captures.used}
    asked: dict[tuple[int, Any], int] = {}
    answered: list[tuple[int, Any, int]] = []
    for datagram in captures.datagrams:
        for at_ns, number, seen in datagram.sightings():
            vehicle = of_vehicle[number].vehicle
            direction = of_vehicle[number].direction(datagram.sender, seen)
            if vehicle is None:
                continue
            name, block = datagram.summary.message, datagram.summary.block_hash
            if direction == INBOUND and name == "Block Add Request":
                asked[vehicle, block] = at_ns
            elif direction == OUTBOUND and name == "Block Add Response" and datagram.sender == vehicle:
                answered.append((vehicle, block, at_ns))
    for vehicle, block, at_ns in answered:
        if (vehicle, block) in asked and at_ns > asked[vehicle, block]:
            yield vehicle, (at_ns - asked[vehicle, block]) / 1e6


def once(folder: Path) -> dict[str, float]:
    """Play a mission, and return the median answer times of the local agents and of the remote agent."""
    secret = folder / "lab.key"
    create_secret(secret)
    scenario = parse(
        {
            "name": "delay of a remote agent",
            "agents": 3,
            "duration_s": 300,
            "speedup": 10,
            "vehicles": {"kind": "none"},
            "events": {"source": "random", "mean_s": 3},
            "capture": True,
            "remote": {"agents": [REMOTE], "secret_file": str(secret), "listen": ADDRESS},
        }
    )
    join = [sys.executable, "-m", "harness.cli", "join", ADDRESS, "--as", str(REMOTE), "--secret-file", str(secret)]
    agent = [sys.executable, "-P", "-m", "ucp.node"]
    far = subprocess.Popen([*join, "--service", "--", *agent], stdout=subprocess.DEVNULL)
    try:
        finished = run(scenario, 1, folder / "run")
    finally:
        far.terminate()
        far.wait()
    times = list(answer_times(folder / "run"))
    remote = median(ms for vehicle, ms in times if vehicle == REMOTE)
    local = median(ms for vehicle, ms in times if vehicle != REMOTE)
    ping_s = finished.record.remote[str(REMOTE)].delay_s or 0.0
    return {"local_ms": local, "remote_ms": remote, "added_ms": (remote - local) / 2, "ping_ms": 1000 * ping_s}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rounds = []
    for _ in range(arguments.rounds):
        with tempfile.TemporaryDirectory() as folder:
            rounds.append(once(Path(folder)))
    show([{key: Spread.of(each[key] for each in rounds) for key in FORMS}], FORMS, arguments.json)


if __name__ == "__main__":
    main()
