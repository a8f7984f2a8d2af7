"""Measure the rate and the cost of packet captures: `python -m benchmarks.capture [--vehicles N] [--bytes B] [--rounds
R]`.

The benchmark opens a lab without network conditions for each rate. In each lab, one vehicle broadcasts packets at this
rate. With N vehicles, the captures contain N frames of each packet: one at the sender, and one at each other vehicle.
`dropped` is the share of frames that are missing in the files. The kernel counts them. `processor_us` is the processor
time of the capture for each frame, including the writing of the files. The last row is measured without a limit of the
rate.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.rounds import Spread, show
from netem import _probe
from netem.capture import LiveCapture
from netem.errors import LabError, LiveCaptureError
from netem.lab import Lab

_PORT = 14600
_RATES = (5_000, 10_000, 20_000, 40_000)
_BURST = 20  # of netem._probe, between two pauses
_FASTEST = 0
_FASTEST_PACKETS = 200_000

_FORMS = {"packets_per_s": ".0f", "frames_per_s": ".0f", "dropped": ".3f", "processor_us": ".1f"}

_Row = dict[str, Any]


async def once(vehicles: int, rate: int, packets: int, size: int, folder: Path) -> dict[str, float]:
    """Broadcast packets with `size` bytes of data at `rate` packets per second, and return the measured figures.

    A rate of 0 means no limit.
    """
    captures = folder / f"{rate}-{time.monotonic_ns()}"
    captures.mkdir()
    async with await Lab.open(range(1, vehicles + 1), log=folder / "lab.log") as lab:
        capture = await LiveCapture.start(lab, captures)
        await capture.begin(time.time_ns() // 1000, 1)
        seconds = await _broadcast(lab, packets, size, _pause_s(rate), folder)
        counted = (await capture.stop()).values()
    for path in captures.glob("*.pcapng"):
        path.unlink()
    received, dropped = (sum(one[key] for one in counted) for key in ("received", "dropped"))
    return {
        "packets_per_s": packets / seconds,
        "frames_per_s": received / seconds,
        "dropped": dropped / received,
        "processor_us": capture.processor_s / (received - dropped) * 1e6,
    }


def _pause_s(rate: int) -> float:
    """Return the pause between two groups of packets in seconds. Sending a packet takes about 20 microseconds."""
    return max(0.0, _BURST / rate - _BURST * 20e-6) if rate else 0.0


async def _broadcast(lab: Lab, packets: int, size: int, pause_s: float, folder: Path) -> float:
    """Broadcast the packets from vehicle 1, and return the duration in seconds."""
    numbers = (_PORT, packets, 0, lab.broadcast, size, pause_s)
    argv = [sys.executable, "-I", "-S", _probe.__file__, "broadcast", *map(str, numbers)]
    output = folder / "broadcast.log"
    start = time.perf_counter()
    sender = await lab.spawn(1, argv, cwd=folder, env=dict(os.environ), stdout=output, stderr=output)
    if (status := await sender.wait()) != 0:
        raise LabError(f"The sender ended with status {status}")
    return time.perf_counter() - start


def row(vehicles: int, rate: int, seconds: float, size: int, rounds: int, folder: Path) -> _Row:
    packets = round(rate * seconds) or _FASTEST_PACKETS
    found = [asyncio.run(once(vehicles, rate, packets, size, folder)) for _ in range(rounds)]
    figures = {key: Spread.of(one[key] for one in found) for key in found[0]}
    return {"asked_per_s": rate or "fastest", **figures}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=5, help="number of vehicles")
    parser.add_argument("--seconds", type=float, default=5.0, help="duration at each rate")
    parser.add_argument("--bytes", type=int, default=300, help="bytes of data in each packet")
    parser.add_argument("--rounds", type=int, default=3, help="number of rounds")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    try:
        with tempfile.TemporaryDirectory() as folder:
            rows = [
                row(options.vehicles, rate, options.seconds, options.bytes, options.rounds, Path(folder))
                for rate in (*_RATES, _FASTEST)
            ]
    except (LabError, LiveCaptureError) as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(3)
    show(rows, _FORMS, options.json)


if __name__ == "__main__":
    main()
