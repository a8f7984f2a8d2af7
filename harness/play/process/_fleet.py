"""The vehicles of one run as programs: made ready, flown, seen at a ground station, lost and replaced."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from harness.archive.directory import RunDirectory
from harness.errors import ScenarioError
from harness.play.process._run_lab import MissionLab
from harness.play.process._vehicle_process import VehicleProcess
from harness.play.process._watchers import Watchers
from harness.scenario import Scenario
from netem.radio import Place
from sitl.address import Address
from sitl.circumstances import Circumstance
from sitl.ground_station import GroundStation
from sitl.system_ids import system_ids
from sitl.vehicle import Home, VehicleError, VehicleKind
from ucp.clock import MissionClock


class Fleet:
    """A vehicle for each agent of the roster, by its ID; false if the run has none (`kinds` is empty).

    What goes wrong with a vehicle, VehicleFailedError, ends the mission by way of the watchers.
    """

    def __init__(
        self,
        scenario: Scenario,
        kinds: Mapping[int, VehicleKind],
        rundir: RunDirectory,
        clock: MissionClock,
        watchers: Watchers,
    ) -> None:
        self._scenario = scenario
        self._kinds = kinds
        self._rundir = rundir
        self._clock = clock
        self._watchers = watchers
        self._sysids = system_ids(scenario.roster)
        self._vehicles = {vehicle_id: self._vehicle(vehicle_id) for vehicle_id in scenario.roster if kinds}
        self._station: GroundStation | None = None

    def __bool__(self) -> bool:
        return bool(self._vehicles)

    def _vehicle(self, vehicle_id: int, life: int = 1) -> VehicleProcess:
        return VehicleProcess(vehicle_id, self._sysids[vehicle_id], self._kinds[vehicle_id], self._rundir, life)

    async def start(self, lab: MissionLab, show: Callable[[str], None]) -> None:
        """Start them all, and return when all are ready to arm; `show` is told how far they are.

        Raises VehicleFailedError, and ScenarioError if there is no way to the ground station.
        """
        if not self._vehicles:
            return
        show("starting vehicles")
        await asyncio.gather(*(self._boot(vehicle, lab) for vehicle in self._vehicles.values()))
        if self._scenario.gcs:
            self._station = await self._open_station(Address.parse(self._scenario.gcs))
        for vehicle in self._vehicles.values():
            await self._take_charge_of(vehicle, lab)
        readied = [self._watchers.task(vehicle.get_ready()) for vehicle in self._vehicles.values()]
        for ready, next_one in enumerate(asyncio.as_completed(readied)):
            show(f"{ready} of {len(readied)} vehicles are ready")
            await next_one

    async def _boot(self, vehicle: VehicleProcess, lab: MissionLab) -> None:
        await vehicle.start(lab, self._home_of(vehicle.vehicle_id), self._scenario.speedup)

    def _home_of(self, vehicle_id: int) -> Home:
        return self._scenario.vehicles.home_of(vehicle_id, self._scenario.roster.index(vehicle_id))

    async def _open_station(self, address: Address) -> GroundStation:
        try:
            return await GroundStation.open(address, self._clock.now, self._hand_over)
        except VehicleError as error:
            raise ScenarioError(str(error)) from None

    def _hand_over(self, vehicle_ids: Sequence[int]) -> None:
        for vehicle_id in vehicle_ids:
            self._vehicles[vehicle_id].hand_over()

    async def _take_charge_of(self, vehicle: VehicleProcess, lab: MissionLab) -> None:
        """Of one that has just been started."""
        self._watchers.start(vehicle.watch(), of=f"vehicle {vehicle.vehicle_id}")
        flight = self._scenario.flight_of(vehicle.vehicle_id)
        vehicle.prepare(flight, self._scenario.vehicles.takeoff_altitude_m)
        if self._station is not None:
            await vehicle.join(self._station, lab)

    def take_off(self) -> None:
        """All of them begin to fly what they are to fly."""
        for vehicle in self._vehicles.values():
            self._fly(vehicle)

    def _fly(self, vehicle: VehicleProcess) -> None:
        self._watchers.start(vehicle.fly(), of=f"flight {vehicle.vehicle_id}")

    def places(self) -> dict[int, Place]:
        """Where they last said that they are, in metres from the middle of the field."""
        field = self._scenario.vehicles.field
        return {vehicle_id: vehicle.place(field) for vehicle_id, vehicle in self._vehicles.items()}

    # What can happen to one

    async def shoot_down(self, vehicle_id: int) -> None:
        """Nothing happens if the run has no vehicles."""
        if not self._vehicles:
            return
        self._watchers.stop(f"flight {vehicle_id}")
        self._watchers.stop(f"vehicle {vehicle_id}")
        await self._vehicles[vehicle_id].kill()

    async def replace(self, vehicle_id: int, lab: MissionLab, life: int) -> None:
        """Another takes its place, and flies what it flew. Nothing happens if the run has no vehicles."""
        if not self._vehicles:
            return
        await self.shoot_down(vehicle_id)  # a wreck still holds its ports
        vehicle = self._vehicles[vehicle_id] = self._vehicle(vehicle_id, life)
        await self._boot(vehicle, lab)
        await self._take_charge_of(vehicle, lab)
        self._fly(vehicle)

    def fall(self, vehicle_id: int) -> None:
        self._watchers.start(self._vehicles[vehicle_id].fall(), of=f"flight {vehicle_id}")

    async def befall(self, vehicle_id: int, what: str, circumstance: Circumstance, at_s: float) -> str | None:
        """As VehicleProcess.befall: returns why the vehicle does not simulate it, if so."""
        return await self._vehicles[vehicle_id].befall(what, circumstance, at_s)

    # The end

    def close_station(self) -> dict[str, Any] | None:
        """No ground station hears them any more; returns what it did, None if there was none."""
        if self._station is None:
            return None
        done = self._station.to_json()
        self._station.close()
        return done

    async def stop(self) -> None:
        await asyncio.gather(*(vehicle.stop() for vehicle in self._vehicles.values()))

    def to_json(self) -> dict[str, Any]:
        return {str(vehicle_id): vehicle.to_json() for vehicle_id, vehicle in self._vehicles.items()}
