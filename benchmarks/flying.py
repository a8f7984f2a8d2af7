"""Measure the processor time of a swarm of real vehicle programs: `python -m benchmarks.flying [--vehicles 20]
[--seconds 90]`.

ArduCopters fly a plan at speedup 1, and their agents lose 15 % of the messages. A ground station requests four updates
per second from each vehicle, and a client reads the live page. Ground station and client run in the process of the
benchmark, whose processor time does not count. The benchmark prints the processor seconds (user and system) of the
vehicles, and those of the other parts (agents, harness, and the server of the page). A vehicle keeps up if its
real-time factor is at least 0.99. The other parts should use at most 60 % of a core. The environment variable
ARDUPILOT_SITL names the directory with the binary.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import aiohttp
import yaml
from pymavlink.dialects.v20 import ardupilotmega as mavlink

TICKS_PER_S = os.sysconf("SC_CLK_TCK")
UPDATES_PER_S = 4


def scenario(vehicles: int, seconds: float) -> dict[str, Any]:
    plan = [{"take_off": 20}, {"go_to": [100, 0]}, {"go_to": [0, 100]}, {"go_to": [0, 0]}]
    return {
        "name": "Real copters",
        "agents": vehicles,
        "duration_s": seconds,
        "speedup": 1,
        "network": {"loss": 0.15},
        "settle": {"limit_s": 60},
        "vehicles": {"kind": "ardupilot"},
        "flight": [{"vehicles": [*range(1, vehicles + 1)], "plan": plan}],
    }


class GroundStation(asyncio.DatagramProtocol):
    """A ground station that requests all types of messages from each vehicle, and counts the received bytes."""

    def __init__(self) -> None:
        self.taken = 0
        self._seen: set[int] = set()
        self._mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport: Any = transport

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self.taken += len(data)
        sysid = data[5]  # MAVLink 2
        if sysid not in self._seen:
            self._seen.add(sysid)
            ask = mavlink.MAVLink_request_data_stream_message(sysid, 1, mavlink.MAV_DATA_STREAM_ALL, UPDATES_PER_S, 1)
            self._transport.sendto(bytes(ask.pack(self._mav)), addr)


def spent(root: int, run: Path) -> dict[str, float]:
    """Return the processor seconds that a process and its descendants have used, by the part of the run to which they
    belong.
    """
    processes: dict[int, tuple[int, float]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            processes[int(entry.name)] = int(fields[1]), (int(fields[11]) + int(fields[12])) / TICKS_PER_S
    seconds: Counter[str] = Counter()
    for pid in _descendants(root, processes):
        seconds[_what(pid, run)] += processes[pid][1]
    return dict(seconds)


def _descendants(root: int, processes: dict[int, tuple[int, float]]) -> Iterator[int]:
    family = {root}
    for pid in sorted(processes, key=lambda pid: pid != root):
        line = [pid]
        while line[-1] in processes and line[-1] not in family:
            line.append(processes[line[-1]][0])
        if line[-1] in family:
            family.update(line)
    return iter(family & processes.keys())


def _what(pid: int, run: Path) -> str:
    try:
        directory = Path(f"/proc/{pid}/cwd").readlink()
        started_as = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return "the harness"
    for folder in ("vehicles", "agents"):
        if directory.is_relative_to(run / folder):
            return folder
    return "the page's server" if b"harness.report.live" in started_as else "the harness"


async def fly(run: Path, asked: Path, seconds: float) -> None:
    loop = asyncio.get_running_loop()
    transport, station = await loop.create_datagram_endpoint(GroundStation, local_addr=("127.0.0.1", 0))
    address = f"127.0.0.1:{transport.get_extra_info('sockname')[1]}"
    program = Path(sys.executable).with_name("ucp-harness")
    command = [str(program), "run", str(asked), "--out", str(run), "--gcs", address, "--watch"]
    harness = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    assert harness.stdout is not None
    page = ""
    while line := (await harness.stdout.readline()).decode():
        if "http://" in line:
            page = line.split()[-1]
            break
    draining = asyncio.create_task(harness.stdout.read())
    watched = 0
    marks: list[tuple[float, dict[str, float]]] = []
    async with aiohttp.ClientSession() as client, client.ws_connect(f"{page}live", max_msg_size=0) as socket:
        async for message in socket:
            watched += len(message.data)
            for change in map(json.loads, message.data.splitlines()):
                if change[0] == "hand":
                    is_flying = change[1]["stage"] == "mission"
                    if is_flying != (len(marks) == 1) and len(marks) < 2:
                        marks.append((loop.time(), spent(harness.pid, run)))
            if len(marks) == 2:
                break
    await draining
    await harness.wait()
    _tell(marks, run, station.taken, watched)


def _tell(marks: list[tuple[float, dict[str, float]]], run: Path, taken: int, watched: int) -> None:
    (began, before), (ended, after) = marks
    wall_s = ended - began
    shares = {what: (after[what] - before.get(what, 0)) / wall_s for what in sorted(after)}
    record = json.loads((run / "run.json").read_text())
    factors = sorted(vehicle["real_time_factor"] for vehicle in record["vehicles"].values())
    print(f"{len(factors)} vehicles, {wall_s:.0f} s of mission, {record['outcome']}; a core for:")  # noqa: T201
    for what, share in shares.items():
        print(f"  {what}: {share:.1%}")  # noqa: T201
    print(f"  all but the vehicles: {sum(shares.values()) - shares['vehicles']:.1%}")  # noqa: T201
    print(f"real-time factor: least {factors[0]}, median {factors[len(factors) // 2]}")  # noqa: T201
    print(f"ground station {taken / wall_s / 1000:.0f} kB/s, page {watched / wall_s / 1000:.0f} kB/s")  # noqa: T201


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=20, help="number of vehicles")
    parser.add_argument("--seconds", type=float, default=90.0, help="seconds of mission")
    asked = parser.parse_args()
    if "ARDUPILOT_SITL" not in os.environ:
        sys.exit("ARDUPILOT_SITL is not set: set it to the directory with arducopter and its default parameters")
    with TemporaryDirectory() as place:
        file = Path(place, "copters.yaml")
        file.write_text(yaml.safe_dump(scenario(asked.vehicles, asked.seconds)))
        asyncio.run(fly(Path(place).resolve() / "run", file, asked.seconds))


if __name__ == "__main__":
    main()
