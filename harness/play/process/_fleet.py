"""Start, fly and replace the vehicle programs of a run, and connect them to a ground station."""

import asyncio
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from functools import partial
from typing import Any

from harness.archive.directory import RunDirectory
from harness.archive.run_record import GroundStationRecord
from harness.errors import ScenarioError
from harness.play._radio_range import track_of
from harness.play.process._run_lab import VehicleLab
from harness.play.process._vehicle_process import VehicleProcess
from harness.play.process._watchers import MissionTasks
from harness.scenario import Scenario
from netem.radio import Place
from sitl.address import ListenAddress
from sitl.circumstances import SimulatedFailure
from sitl.ground_station import GroundStation
from sitl.system_ids import system_ids
from sitl.vehicle import Home, VehicleError, VehicleKind
from ucp.clock import MissionClock

LATE_S = 10.0
"""Maximum lateness of the take-off of a vehicle, compared with its computed take-off, in mission seconds. ArduPilot or
a busy machine can cause this lateness.
"""
AWAY_M = 5.0


class Fleet:
    """The vehicles of a run, one for each agent. `bool(fleet)` is false in a run without vehicles.

    The tasks in `watchers` end the mission with VehicleFailedError when a vehicle fails.
    """

    def __init__(
        self,
        scenario: Scenario,
        kinds: Mapping[int, VehicleKind],
        rundir: RunDirectory,
        clock: MissionClock,
        watchers: MissionTasks,
        lost_worker: Callable[[int], str | None] | None = None,
    ) -> None:
        """Create the vehicles without starting them. On a cluster, `lost_worker` is a function with the ID of a vehicle
        as its argument. If the worker that ran this vehicle is lost, the function returns the address of the worker.
        Otherwise the function returns None.
        """
        self._scenario = scenario
        self._kinds = kinds
        self._rundir = rundir
        self._clock = clock
        self._watchers = watchers
        self._lost_worker = lost_worker or (lambda vehicle_id: None)
        self._sysids = system_ids(scenario.roster)
        self._vehicles = {vehicle_id: self._vehicle(vehicle_id) for vehicle_id in scenario.roster if kinds}
        self._station: GroundStation | None = None
        self._flies_since_s: dict[int, float] = {}

    def __bool__(self) -> bool:
        return bool(self._vehicles)

    def _vehicle(self, vehicle_id: int, incarnation: int = 1) -> VehicleProcess:
        sysid, kind = self._sysids[vehicle_id], self._kinds[vehicle_id]
        lost_worker = partial(self._lost_worker, vehicle_id)
        return VehicleProcess(vehicle_id, sysid, kind, self._rundir, incarnation, lost_worker)

    async def start(
        self, lab: VehicleLab, limit: AbstractAsyncContextManager[object], show: Callable[[str], None]
    ) -> None:
        """Start all vehicles, and wait until all vehicles can be armed. Each vehicle starts inside the context `limit`.
        `show` receives the progress as text. Raises VehicleFailedError, and ScenarioError if the ground station cannot
        be reached.
        """
        if not self._vehicles:
            return
        show("starting vehicles")

        async def boot(vehicle: VehicleProcess) -> None:
            async with limit:
                await self._boot(vehicle, lab)

        await asyncio.gather(*map(boot, self._vehicles.values()))
        if self._scenario.gcs:
            self._station = await self._open_station(ListenAddress.parse(self._scenario.gcs))
        for vehicle in self._vehicles.values():
            await self._supervise(vehicle, lab)
        readied = [self._watchers.create_task(vehicle.get_ready()) for vehicle in self._vehicles.values()]
        for ready, next_one in enumerate(asyncio.as_completed(readied)):
            show(f"{ready} of {len(readied)} vehicles are ready")
            await next_one

    async def _boot(self, vehicle: VehicleProcess, lab: VehicleLab) -> None:
        await vehicle.start(lab, self._home_of(vehicle.vehicle_id), self._scenario.speedup)

    def _home_of(self, vehicle_id: int) -> Home:
        return self._scenario.vehicles.home_of(vehicle_id, self._scenario.roster.index(vehicle_id))

    async def _open_station(self, address: ListenAddress) -> GroundStation:
        try:
            return await GroundStation.open(address, self._clock.now, self._hand_over)
        except VehicleError as error:
            raise ScenarioError(str(error)) from None

    def _hand_over(self, vehicle_ids: Sequence[int]) -> None:
        for vehicle_id in vehicle_ids:
            self._vehicles[vehicle_id].hand_over()

    async def _supervise(self, vehicle: VehicleProcess, lab: VehicleLab) -> None:
        """Watch a vehicle that has just started, give it its flight plan, and connect it to the ground station."""
        self._watchers.start(vehicle.watch(), of=f"vehicle {vehicle.vehicle_id}")
        flight = self._scenario.flight_of(vehicle.vehicle_id)
        vehicle.prepare(flight, self._scenario.vehicles.takeoff_altitude_m)
        if self._station is not None:
            await vehicle.join(self._station, lab)
            self._station.reach(vehicle.sysid, reachable=True)

    def take_off(self) -> None:
        """Start the flights of all vehicles."""
        for vehicle in self._vehicles.values():
            self._fly(vehicle)

    def _fly(self, vehicle: VehicleProcess) -> None:
        self._flies_since_s[vehicle.vehicle_id] = self._clock.now()
        self._watchers.start(vehicle.fly(), of=f"flight {vehicle.vehicle_id}")

    def places(self) -> dict[int, Place]:
        """Return the last reported positions of the vehicles, in metres from the middle of the field."""
        field = self._scenario.vehicles.field
        return {vehicle_id: vehicle.place(field) for vehicle_id, vehicle in self._vehicles.items()}

    # Faults

    async def shoot_down(self, vehicle_id: int) -> None:
        """Kill the program of a vehicle. In a run without vehicles, do nothing."""
        if not self._vehicles:
            return
        self._watchers.stop(f"flight {vehicle_id}")
        self._watchers.stop(f"vehicle {vehicle_id}")
        await self._vehicles[vehicle_id].kill()

    async def replace(self, vehicle_id: int, lab: VehicleLab, incarnation: int) -> None:
        """Kill the program of a vehicle, and start a new program with the same flight. In a run without vehicles, do
        nothing.
        """
        if not self._vehicles:
            return
        await self.shoot_down(vehicle_id)  # a fallen vehicle still holds its ports
        vehicle = self._vehicles[vehicle_id] = self._vehicle(vehicle_id, incarnation)
        await self._boot(vehicle, lab)
        await self._supervise(vehicle, lab)
        self._fly(vehicle)

    def fall(self, vehicle_id: int) -> None:
        self._watchers.start(self._vehicles[vehicle_id].fall(), of=f"flight {vehicle_id}")

    async def simulate(self, vehicle_id: int, what: str, circumstance: SimulatedFailure, at_s: float) -> str | None:
        """Make a vehicle simulate an event such as a GPS failure. See `VehicleProcess.simulate`."""
        if self._station is not None and circumstance.station_is_heard is not None:
            self._station.reach(self._sysids[vehicle_id], reachable=circumstance.station_is_heard)
        return await self._vehicles[vehicle_id].simulate(what, circumstance, at_s)

    # End of the run

    def shortfalls(self, mission_s: float) -> list[str]:
        """Return a sentence for each vehicle that should have left its home position, but is still there."""
        sentences = (
            vehicle.shortfall() for vehicle in self._vehicles.values() if self._should_have_left(vehicle, mission_s)
        )
        return [sentence for sentence in sentences if sentence is not None]

    def _should_have_left(self, vehicle: VehicleProcess, mission_s: float) -> bool:
        """Return true if the vehicle's computed flight path leaves home more than LATE_S seconds before `mission_s`."""
        track = track_of(self._scenario, vehicle.vehicle_id)
        flown_s = mission_s - LATE_S - self._flies_since_s.get(vehicle.vehicle_id, mission_s)
        return any(math.hypot(*track.at(second)) > AWAY_M for second in range(max(0, math.ceil(flown_s))))

    def close_station(self) -> GroundStationRecord | None:
        """Disconnect the ground station, and return its record for run.json. Return None if the run has no ground
        station.
        """
        if self._station is None:
            return None
        done = GroundStationRecord.model_validate(self._station.to_json())
        self._station.close()
        return done

    async def stop(self) -> None:
        await asyncio.gather(*(vehicle.stop() for vehicle in self._vehicles.values()))

    def to_json(self) -> dict[str, dict[str, Any]]:
        return {str(vehicle_id): vehicle.to_json() for vehicle_id, vehicle in self._vehicles.items()}
