"""What befalls a vehicle rather than its agent: parameters of its simulation, so that its failsafes have causes."""

from __future__ import annotations

from typing import ClassVar

from harness.scenario.faults.fault import RUNNING, Fault, Lives
from harness.scenario.vehicles import Vehicles
from sitl.circumstances import Circumstance
from sitl.vehicle import VEHICLE_TYPES, VehicleType

FALLING = "M-5-2l5 6 5-6M0-6v4"
"""Marks beside those of `fault`: what befalls a vehicle, and the end of it."""
RISING = "M-5 4l5-6 5 6"
TROUBLED, WELL_AGAIN = "its vehicle is in trouble", "its vehicle is well again"


class VehicleFault(Fault):
    """A kind of fault for the vehicles of `agents`, which fly on or act as their failsafes say; the agents run on."""

    needs = (RUNNING,)
    of_types: ClassVar[tuple[VehicleType, ...]] = VEHICLE_TYPES
    """Those that it can befall."""

    @property
    def circumstance(self) -> Circumstance:
        """What the vehicles are to simulate."""
        raise NotImplementedError

    def check(self, vehicles: Vehicles) -> None:
        if vehicles.kind == "none":
            raise ValueError("needs vehicles that it can befall: `vehicles.kind` is none")
        for vehicle in self.agents:
            if (kind := vehicles.type_of(vehicle)) not in self.of_types:
                raise ValueError(f"befalls a {' or a '.join(self.of_types)}, and vehicle {vehicle} is a {kind}")

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.befall(agent_id, self.what, self.circumstance, by_hand=self.by_hand)

    @property
    def whose(self) -> str:
        """ "vehicles 1 2"."""
        return f"vehicle{'s' if len(self.agents) > 1 else ''} {' '.join(map(str, self.agents))}"

    @property
    def detail(self) -> str:
        return self.whose
