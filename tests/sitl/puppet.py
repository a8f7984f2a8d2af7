"""An embedded vehicle in the test's event loop. The test can change the messages that the vehicle sends."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from sitl._autopilot import Autopilot
from sitl.pilot import Pilot
from sitl.serial_channel import ClientChannel
from sitl.vehicle import VehicleType
from tests.sitl.flying import HOME

SPEEDUP = 200.0
TURN_S = 0.005


class Puppet:
    """An embedded vehicle. The function `tamper` may change each frame that the vehicle sends. Simulated time runs at
    SPEEDUP.
    """

    def __init__(self, vehicle_type: VehicleType, sock: socket.socket) -> None:
        self.vehicle = Autopilot(3, HOME, 0, vehicle_type)
        self.tamper: Callable[[bytes], bytes] = lambda frame: frame
        self._channel = ClientChannel(self.vehicle)
        self._sock = sock
        self._sock.setblocking(False)

    async def dance(self) -> None:
        while True:
            try:
                if data := self._sock.recv(65536):
                    self._channel.receive(data)
            except BlockingIOError:
                pass
            self.vehicle.advance(self.vehicle.now_s + TURN_S * SPEEDUP)
            self._channel.send_due()
            self._sock.sendall(b"".join(map(self.tamper, frames(self._channel.take()))))
            await asyncio.sleep(TURN_S)

    def leave(self) -> None:
        self._sock.shutdown(socket.SHUT_RDWR)


def frames(data: bytes) -> list[bytes]:
    """Return the MAVLink 2 frames in a byte stream."""
    found = []
    while data:
        length = 12 + data[1]
        found.append(data[:length])
        data = data[length:]
    return found


def message_id(frame: bytes) -> int:
    return int.from_bytes(frame[7:10], "little")


@asynccontextmanager
async def on_strings(tmp_path: Path, vehicle_type: VehicleType = "copter") -> AsyncIterator[tuple[Pilot, Puppet]]:
    ours, theirs = socket.socketpair()
    pilot = Pilot(3, ours, tmp_path / "3.tlog", SPEEDUP, HOME, vehicle_type)
    puppet = Puppet(vehicle_type, theirs)
    dancing = asyncio.create_task(puppet.dance())
    await pilot.start()
    try:
        yield pilot, puppet
    finally:
        dancing.cancel()
        await asyncio.gather(dancing, return_exceptions=True)
        await pilot.close()
        theirs.close()
