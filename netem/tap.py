"""The program that captures: `python -m netem.tap FOLDER VEHICLE...`, in the lab's own network, where the ports are.

It says "ready" as soon as every port is tapped. What crosses the ports then waits in memory until SIGUSR1 says that
FOLDER/<ID>.pcapng have been begun, and is appended to them. On SIGTERM no more is let in; what there is is written, and
how much that was: last in each file, and for all in one JSON object on standard output. Of a process that stood still
SIGTERM may be seen first; that the mission began then is to be seen from the files. On a port directions are the
switch's; in a file they are the vehicle's.
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
from netem._ring import BLOCK_BYTES, RETIRE_MS, Ring
from netem.pcapng import PcapngFile

_MEMORY = 256 << 20
"""Bytes of all rings together, at most: the faster one port is, the slower are the others, on one machine."""
_RING_MEMORY = 16 << 20
"""Bytes of one ring, at most: a second of 10,000 of the largest frames."""
_FEWEST_BLOCKS = 8  # of a ring, even if that is more for all
_DRAIN_S = 10.0
"""After a block's age at most, if the kernel keeps its word."""


class Tap:
    """One vehicle's port, and its file."""

    def __init__(self, vehicle: int, blocks: int) -> None:
        self.vehicle = vehicle
        self.ring = Ring(addresses.port(vehicle), blocks)

    def open(self, folder: Path) -> bool:
        """Whether its file has been begun; raises OSError."""
        path = folder / f"{self.vehicle}.pcapng"
        begun = path.exists()
        if begun:
            self._file = PcapngFile(path)
        return begun

    def write(self) -> None:
        """Raises OSError."""
        for at_ns, frame, leaves_port in self.ring.take():
            self._file.packet(at_ns, frame, outbound=not leaves_port)
        self._file.flush()

    def end(self) -> dict[str, int]:
        """Raises OSError."""
        counted = {"received": self.ring.received, "dropped": self.ring.received - self._file.packets}
        self._file.statistics(time.time_ns(), **counted)
        self._file.close()
        return counted


def capture(folder: Path, vehicles: Sequence[int]) -> None:
    """Raises OSError."""
    asked, wake = socket.socketpair()
    for number in (signal.SIGUSR1, signal.SIGTERM):
        signal.signal(number, lambda number, _: wake.send(bytes([number])))
    blocks = max(_FEWEST_BLOCKS, min(_RING_MEMORY, _MEMORY // len(vehicles)) // BLOCK_BYTES)
    taps = [Tap(vehicle, blocks) for vehicle in vehicles]
    _say("ready")
    stopping = asked.recv(1)[0] == signal.SIGTERM
    taps = [tap for tap in taps if tap.open(folder)]  # if there are none, the mission never began
    while not (stopping or select.select([asked], [], [], RETIRE_MS / 1000)[0]):
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
    _say({"vehicles": counted, "processor_s": used.ru_utime + used.ru_stime})


def _say(what: object) -> None:
    """One line of JSON on standard output."""
    sys.stdout.write(f"{json.dumps(what)}\n")
    sys.stdout.flush()


def main() -> None:
    try:
        capture(Path(sys.argv[1]), [int(vehicle) for vehicle in sys.argv[2:]])
    except OSError as error:
        sys.exit(f"{error.strerror}{f': {error.filename}' if error.filename else ''}")


if __name__ == "__main__":
    main()
