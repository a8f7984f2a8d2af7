"""Show the flight paths of a simulated run on a ground station. The station can display vehicles, but not command
them.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Self

from harness.archive.run_record import GroundStationRecord
from harness.errors import ScenarioError
from harness.scenario import Scenario
from sitl.address import ListenAddress
from sitl.ground_station import GroundStation
from sitl.serial_channel import ClientChannel
from sitl.shown_vehicle import ShownVehicle
from sitl.streams import heartbeat
from sitl.system_ids import system_ids
from sitl.track import VehicleTrack
from sitl.vehicle import VehicleError

SHOW_S = 0.25
"""Minimum seconds of wall time between two updates of the ground station. The minimum keeps the cost of updates
independent of the speedup.
"""
SILENT_S = 1.0
"""Seconds of wall time after which a vehicle sends a heartbeat, even if virtual time is paused. A ground station
reports a vehicle without heartbeats as lost.
"""
READ_BYTES = 65_536


@dataclass
class _StationConnection:
    vehicle: ShownVehicle
    channel: ClientChannel
    sock: socket.socket
    sent_at: float = 0.0


class StationTracks:
    """The connections between a simulated run and its ground station. All of them must be used in one event loop, and
    closed after the run.
    """

    def __init__(self, station: GroundStation) -> None:
        """Create the object without connections. Callers use `open` instead."""
        self._station = station
        self._connections: dict[int, _StationConnection] = {}
        self._shown_at = 0.0

    @classmethod
    async def open(cls, scenario: Scenario, tracks: Mapping[int, VehicleTrack], now: Callable[[], float]) -> Self:
        """Connect all vehicles to the ground station. Raises ScenarioError if the ground station cannot be reached."""
        assert scenario.gcs is not None
        try:
            station = await GroundStation.open(ListenAddress.parse(scenario.gcs), now, lambda vehicles: None)
        except VehicleError as error:
            raise ScenarioError(str(error)) from None
        shown, epoch_us, numbers = cls(station), time.time_ns() // 1000, system_ids(scenario.roster)
        for number, vehicle_id in enumerate(scenario.roster):
            home, vehicle_type = scenario.vehicles.home_of(vehicle_id, number), scenario.vehicles.type_of(vehicle_id)
            vehicle = ShownVehicle(numbers[vehicle_id], home, epoch_us, vehicle_type, tracks[vehicle_id])
            ours, theirs = socket.socketpair()
            ours.setblocking(False)
            shown._connections[vehicle_id] = _StationConnection(vehicle, ClientChannel(vehicle), ours)
            await station.attach(vehicle_id, vehicle.sysid, theirs)
        return shown

    def show(self, mission_s: float, lost: set[int]) -> None:
        """Send the positions of all vehicles except the `lost` vehicles to the ground station. Do nothing if the last
        update was less than `SHOW_S` ago.
        """
        if (at := time.monotonic()) - self._shown_at < SHOW_S:
            return
        self._shown_at = at
        for vehicle_id, connection in self._connections.items():
            if vehicle_id in lost:
                continue
            connection.vehicle.show(mission_s)
            with contextlib.suppress(BlockingIOError, ConnectionError):
                connection.channel.receive(connection.sock.recv(READ_BYTES))
            connection.channel.send_due()
            if at - connection.sent_at >= SILENT_S:
                connection.channel.send(heartbeat(connection.vehicle))
            if data := connection.channel.take():
                connection.sent_at = at
                with contextlib.suppress(
                    BlockingIOError, ConnectionError
                ):  # a station that reads too slowly misses messages
                    connection.sock.send(data)

    def close(self) -> GroundStationRecord:
        """Close all connections to the ground station. Return the record of these connections for run.json."""
        passed = GroundStationRecord.model_validate(self._station.to_json())
        self._station.close()
        for connection in self._connections.values():
            connection.sock.close()
        return passed
