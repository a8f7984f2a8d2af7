"""The tracks of a run in virtual time, on a ground station: seen as vehicles are, and commanded by nobody."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Self

from harness.errors import ScenarioError
from harness.scenario import Scenario
from sitl.address import Address
from sitl.ground_station import GroundStation
from sitl.serial_channel import Channel
from sitl.shown_vehicle import ShownVehicle
from sitl.streams import heartbeat
from sitl.system_ids import system_ids
from sitl.track import Track
from sitl.vehicle import VehicleError

SHOW_S = 0.25
"""Wall time between two looks at the tracks, at least: what that costs must not grow with the speedup."""
SILENT_S = 1.0
"""Of wall time: who stands still says that it is there, or a ground station takes it for lost."""
READ_BYTES = 65_536


@dataclass
class _OnAir:
    vehicle: ShownVehicle
    channel: Channel
    sock: socket.socket
    said_at: float = 0.0


class TracksOnStation:
    """Of one run; in one event loop. Close it."""

    def __init__(self, station: GroundStation) -> None:
        """Use `open`."""
        self._station = station
        self._on_air: dict[int, _OnAir] = {}
        self._shown_at = 0.0

    @classmethod
    async def open(cls, scenario: Scenario, tracks: Mapping[int, Track], now: Callable[[], float]) -> Self:
        """Raises ScenarioError if there is no way to the ground station."""
        assert scenario.gcs is not None
        try:
            station = await GroundStation.open(Address.parse(scenario.gcs), now, lambda vehicles: None)
        except VehicleError as error:
            raise ScenarioError(str(error)) from None
        shown, epoch_us, numbers = cls(station), time.time_ns() // 1000, system_ids(scenario.roster)
        for number, vehicle_id in enumerate(scenario.roster):
            home, vehicle_type = scenario.vehicles.home_of(vehicle_id, number), scenario.vehicles.type_of(vehicle_id)
            vehicle = ShownVehicle(numbers[vehicle_id], home, epoch_us, vehicle_type, tracks[vehicle_id])
            ours, theirs = socket.socketpair()
            ours.setblocking(False)
            shown._on_air[vehicle_id] = _OnAir(vehicle, Channel(vehicle), ours)
            await station.attach(vehicle_id, vehicle.sysid, theirs)
        return shown

    def show(self, mission_s: float, lost: set[int]) -> None:
        """Say where the vehicles are that are not `lost`, unless that was a moment ago."""
        if (at := time.monotonic()) - self._shown_at < SHOW_S:
            return
        self._shown_at = at
        for vehicle_id, on_air in self._on_air.items():
            if vehicle_id in lost:
                continue
            on_air.vehicle.show(mission_s)
            with contextlib.suppress(BlockingIOError, ConnectionError):
                on_air.channel.receive(on_air.sock.recv(READ_BYTES))
            on_air.channel.send_due()
            if at - on_air.said_at >= SILENT_S:
                on_air.channel.send(heartbeat(on_air.vehicle))
            if data := on_air.channel.take():
                on_air.said_at = at
                with contextlib.suppress(BlockingIOError, ConnectionError):  # whoever reads too slowly misses something
                    on_air.sock.send(data)

    def close(self) -> dict[str, Any]:
        """End all connections; what passed over them, for the record."""
        passed = self._station.to_json()
        self._station.close()
        for on_air in self._on_air.values():
            on_air.sock.close()
        return passed
