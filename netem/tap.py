"""Capture packets in a separate process: `python -m netem.tap FOLDER VEHICLE...`, started in the virtual network.

The program prints "ready" when it captures all ports. It then keeps frames in memory until SIGUSR1. Before this signal,
the caller creates the files FOLDER/<ID>.pcapng, and the program then appends the frames to these files. SIGTERM ends
the capture. The program then writes the remaining frames and the counters. The counters of each port are at the end of
its file. One JSON object on standard output contains the counters of all ports. A suspended process may receive SIGTERM
before SIGUSR1. In this case the process checks whether the files exist, because they show that the mission began. A
frame that enters the switch at a port is outbound in the vehicle's file. A frame that leaves the switch is inbound.
"""

from __future__ import annotations

import json
import resource
import select
import signal
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from netem import addresses
from netem._ring import BLOCK_BYTES, RETIRE_MS, CaptureRing
from netem.pcapng import PcapngFile

_MEMORY = 256 << 20
"""Maximum size of all ring buffers together, in bytes."""
_RING_MEMORY = 16 << 20
"""Maximum size of one ring buffer in bytes. It holds 10,000 of the largest frames, which is about one second of
traffic.
"""
_FEWEST_BLOCKS = 8  # for each ring, even above the total maximum
_DRAIN_S = 10.0
"""Maximum number of seconds to wait for the last frames. The kernel hands over each block after at most `RETIRE_MS`."""


class PortTap:
    """The port and the capture file of one vehicle."""

    def __init__(self, vehicle: int, blocks: int) -> None:
        self.vehicle = vehicle
        self.ring = CaptureRing(addresses.port(vehicle), blocks)

    def open(self, folder: Path) -> bool:
        """Open the capture file if it exists. Return whether it exists. Raises OSError."""
        path = folder / f"{self.vehicle}.pcapng"
        exists = path.exists()
        if exists:
            self._file = PcapngFile(path)
        return exists

    def write(self) -> None:
        """Write the available frames to the file. Raises OSError."""
        for at_ns, frame, leaves_port in self.ring.take():
            self._file.packet(at_ns, frame, outbound=not leaves_port)
        self._file.flush()

    def end(self) -> dict[str, int]:
        """Write the counters, and close the file. Raises OSError."""
        counted = {"received": self.ring.received, "dropped": self.ring.received - self._file.packets}
        self._file.statistics(time.time_ns(), **counted)
        self._file.close()
        return counted


def capture(folder: Path, vehicles: Sequence[int]) -> None:
    """Capture packets until SIGTERM. Raises OSError."""
    signals, wake = socket.socketpair()
    for number in (signal.SIGUSR1, signal.SIGTERM):
        signal.signal(number, lambda number, _: wake.send(bytes([number])))
    blocks = max(_FEWEST_BLOCKS, min(_RING_MEMORY, _MEMORY // len(vehicles)) // BLOCK_BYTES)
    taps = [PortTap(vehicle, blocks) for vehicle in vehicles]
    _print_json("ready")
    stopping = signals.recv(1)[0] == signal.SIGTERM
    taps = [tap for tap in taps if tap.open(folder)]  # without files, the mission never began
    while not (stopping or select.select([signals], [], [], RETIRE_MS / 1000)[0]):
        for tap in taps:
            tap.write()
    for tap in taps:
        tap.ring.stop()
    deadline = time.monotonic() + _DRAIN_S
    waiting = 1
    while waiting and time.monotonic() < deadline:
        time.sleep(RETIRE_MS / 1000)
        for tap in taps:
            tap.write()
        waiting = sum(tap.ring.count() for tap in taps)
    counted = {tap.vehicle: tap.end() for tap in taps}
    used = resource.getrusage(resource.RUSAGE_SELF)
    _print_json({"vehicles": counted, "processor_s": used.ru_utime + used.ru_stime})


def _print_json(what: object) -> None:
    """Print an object as one line of JSON."""
    sys.stdout.write(f"{json.dumps(what)}\n")
    sys.stdout.flush()


def main() -> None:
    try:
        capture(Path(sys.argv[1]), [int(vehicle) for vehicle in sys.argv[2:]])
    except OSError as error:
        sys.exit(f"{error.strerror}{f': {error.filename}' if error.filename else ''}")


if __name__ == "__main__":
    main()
