"""Vehicles on one UDP port of a ground station: QGroundControl, Mission Planner, MAVProxy or any MAVLink client.

Each vehicle has a port for ground stations (STATION_PORT) beside its pilot's and its agent's, so that what an operator
asks for disturbs neither. A `GroundStation` carries whole frames from all of these to one UDP address, and what comes
back from there to the vehicle that it is for, both ways without changing a byte.
"""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Callable
from typing import Any, Self, cast

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl._mavlink_frames import FrameSplitter
from sitl._operator import CommandLog
from sitl.address import Address, connected

MOST_DATAGRAMS_PER_S = 1000
"""From the ground station; more are dropped, and counted."""
MOST_DATAGRAM_BYTES = 4096
MOST_WAITING_BYTES = 64 * 1024
"""That a vehicle does not take at the moment; more is dropped, and counted."""
DATAGRAM_BYTES = 1400
"""Frames of one vehicle that come together go together, in datagrams of at most so many bytes."""


class GroundStation(asyncio.DatagramProtocol):
    """Carries frames between vehicles and one ground station, which may come and go. Use it in one event loop."""

    def __init__(self, address: Address, now: Callable[[], float], taken_over: Callable[[list[int]], None]) -> None:
        """`now` is the mission second when a command is taken down, `taken_over` hears whom it flies. Use `open`."""
        self._address = address
        self._now = now
        self._taken_over = taken_over
        self._transport: asyncio.DatagramTransport | None = None
        self._vehicles: dict[int, _Vehicle] = {}
        """By MAVLink system ID."""
        self._mav = mavlink.MAVLink(None)
        self._commands = CommandLog()
        self._sent = self._received = self._dropped = 0
        self._second, self._in_second = 0, 0
        self._full = False
        """The network takes nothing more at the moment."""

    @classmethod
    async def open(cls, address: Address, now: Callable[[], float], taken_over: Callable[[list[int]], None]) -> Self:
        """As `GroundStation`. Raises VehicleError if there is no way to the address."""
        station = cls(address, now, taken_over)
        sock = await asyncio.to_thread(connected, address)  # a name may have to be looked up
        sock.setblocking(False)
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: station, sock=sock)
        return station

    async def attach(self, vehicle_id: int, sysid: int, sock: socket.socket) -> None:
        """Take over `sock`, connected to the vehicle's port for ground stations, in the place of an earlier one's."""
        sock.setblocking(False)
        vehicle = _Vehicle(vehicle_id, self._forward)
        await asyncio.get_running_loop().create_connection(lambda: vehicle, sock=sock)
        if before := self._vehicles.get(sysid):
            before.close()
        self._vehicles[sysid] = vehicle

    def close(self) -> None:
        """End all connections; may be called twice."""
        for vehicle in self._vehicles.values():
            vehicle.close()
        if self._transport is not None:
            self._transport.abort()

    def to_json(self) -> dict[str, Any]:
        return {
            "address": str(self._address),
            "sent": self._sent,
            "received": self._received,
            "dropped": self._dropped + sum(vehicle.dropped for vehicle in self._vehicles.values()),
            "commands": self._commands.to_json(),
            "commands_left_out": self._commands.left_out,
        }

    def _forward(self, frames: list[bytes]) -> None:
        """From a vehicle to the ground station."""
        transport = self._transport
        if transport is None or transport.is_closing():
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
        """From the ground station, as only its address is listened to, to whom it is for."""
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
            heard = [vehicle for sysid, vehicle in self._vehicles.items() if target in (0, sysid)]
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
        """Nobody listens there, at the moment."""


class _Vehicle(asyncio.Protocol):
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
