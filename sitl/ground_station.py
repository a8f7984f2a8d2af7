"""Connect vehicles with a ground station over UDP: QGroundControl, Mission Planner, MAVProxy or another program.

Each vehicle has a port for ground stations (STATION_PORT), separate from the ports of its pilot and its agent. An
operator therefore does not disturb pilot and agent. A `GroundStation` forwards complete frames between these ports and
one UDP address, in both directions and without changes.
"""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Callable
from typing import Self, cast

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl._mavlink_frames import FrameSplitter
from sitl._operator import CommandLog
from sitl.address import ListenAddress, connected

MOST_DATAGRAMS_PER_S = 1000
"""Maximum number of datagrams per second from the ground station. Further datagrams are dropped and counted."""
MOST_DATAGRAM_BYTES = 4096
MOST_WAITING_BYTES = 64 * 1024
"""Maximum size of data waiting for a slow vehicle. Further data is dropped and counted."""
DATAGRAM_BYTES = 1400
"""Maximum size of a datagram in bytes. Several frames of one vehicle are combined up to this size."""


class GroundStation(asyncio.DatagramProtocol):
    """A forwarder of messages between vehicles and one ground station. The ground station may connect and disconnect at
    any time.

    Use the object in one event loop only.
    """

    def __init__(
        self, address: ListenAddress, now: Callable[[], float], taken_over: Callable[[list[int]], None]
    ) -> None:
        """Create the object. Callers use `open` instead. `now` returns the mission second, for the log of commands.
        When an operator takes over vehicles from the pilot, `taken_over` is called with these vehicles as its argument.
        """
        self._address = address
        self._now = now
        self._taken_over = taken_over
        self._transport: asyncio.DatagramTransport | None = None
        self._vehicles: dict[int, _VehicleConnection] = {}
        """MAVLink system ID -> connection to the vehicle."""
        self._out_of_reach: set[int] = set()
        self._mav = mavlink.MAVLink(None)
        self._commands = CommandLog()
        self._sent = self._received = self._dropped = 0
        self._second, self._in_second = 0, 0
        self._full = False
        """True while the network accepts no more data."""

    @classmethod
    async def open(
        cls, address: ListenAddress, now: Callable[[], float], taken_over: Callable[[list[int]], None]
    ) -> Self:
        """Return an open station. Raises VehicleError if the address cannot be reached."""
        station = cls(address, now, taken_over)
        sock = await asyncio.to_thread(connected, address)  # a name may have to be looked up
        sock.setblocking(False)
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: station, sock=sock)
        return station

    async def attach(self, vehicle_id: int, sysid: int, sock: socket.socket) -> None:
        """Use `sock` as the connection to the vehicle's port for ground stations. An earlier connection to the vehicle
        is closed.
        """
        sock.setblocking(False)
        vehicle = _VehicleConnection(vehicle_id, lambda frames: self._forward(sysid, frames))
        await asyncio.get_running_loop().create_connection(lambda: vehicle, sock=sock)
        if before := self._vehicles.get(sysid):
            before.close()
        self._vehicles[sysid] = vehicle

    def reach(self, sysid: int, *, reachable: bool) -> None:
        """Start or stop forwarding between a vehicle and the ground station, as if their radio link were restored or
        lost. Messages that arrive while forwarding is stopped are lost.
        """
        if reachable:
            self._out_of_reach.discard(sysid)
        else:
            self._out_of_reach.add(sysid)

    def close(self) -> None:
        """End all connections. It may be called twice."""
        for vehicle in self._vehicles.values():
            vehicle.close()
        if self._transport is not None:
            self._transport.abort()

    def to_json(self) -> dict[str, object]:
        return {
            "address": str(self._address),
            "sent": self._sent,
            "received": self._received,
            "dropped": self._dropped + sum(vehicle.dropped for vehicle in self._vehicles.values()),
            "commands": self._commands.to_json(),
            "commands_left_out": self._commands.left_out,
        }

    def _forward(self, sysid: int, frames: list[bytes]) -> None:
        """Forward frames from a vehicle to the ground station."""
        transport = self._transport
        if transport is None or transport.is_closing() or sysid in self._out_of_reach:
            return
        datagram = b""
        for frame in [*frames, b""]:
            if datagram and (not frame or len(datagram) + len(frame) > DATAGRAM_BYTES):
                if self._full:
                    self._dropped += 1
                else:
                    transport.sendto(datagram)
                    self._sent += 1
                datagram = b""
            datagram += frame

    # asyncio.DatagramProtocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)  # asyncio's own is not derived from it

    def datagram_received(self, data: bytes, addr: object) -> None:
        """Forward a datagram from the ground station to its vehicle.

        The socket accepts datagrams only from the address of the ground station.
        """
        second = int(time.monotonic())
        if second != self._second:
            self._second, self._in_second = second, 0
        self._in_second += 1
        if self._in_second > MOST_DATAGRAMS_PER_S or len(data) > MOST_DATAGRAM_BYTES:
            self._dropped += 1
            return
        self._received += 1
        for frame in FrameSplitter().feed(data):  # a datagram holds whole frames
            try:
                message = self._mav.decode(bytearray(frame))
            except mavlink.MAVError:
                self._dropped += 1
                continue
            target = getattr(message, "target_system", 0)
            reached = {sysid for sysid in self._vehicles if target in (0, sysid)} - self._out_of_reach
            heard = [vehicle for sysid, vehicle in self._vehicles.items() if sysid in reached]
            for vehicle in heard:
                vehicle.send(frame)
            vehicle_ids = [vehicle.vehicle_id for vehicle in heard]
            if vehicle_ids and self._commands.note(message, vehicle_ids, self._now()):
                self._taken_over(vehicle_ids)

    def pause_writing(self) -> None:
        self._full = True

    def resume_writing(self) -> None:
        self._full = False

    def error_received(self, exc: Exception) -> None:
        """Ignore the error, which means that no program listens at the address of the ground station at the moment."""


class _VehicleConnection(asyncio.Protocol):
    """The connection to one vehicle's port for ground stations."""

    def __init__(self, vehicle_id: int, forward: Callable[[list[bytes]], None]) -> None:
        self.vehicle_id = vehicle_id
        self.dropped = 0
        self._forward = forward
        self._splitter = FrameSplitter()
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        if frames := self._splitter.feed(data):
            self._forward(frames)

    def send(self, frame: bytes | bytearray) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        if transport.get_write_buffer_size() > MOST_WAITING_BYTES:
            self.dropped += 1
        else:
            transport.write(bytes(frame))

    def close(self) -> None:
        if self._transport is not None:
            self._transport.abort()
