"""Which kind of vehicle flies for each type that a scenario has: ArduPilot, or the embedded vehicle."""

import os

from harness.errors import MachineError
from harness.play.process.vehicle import VehicleFailedError
from harness.scenario import Scenario
from sitl.ardupilot import ArduPilot
from sitl.embedded import Embedded
from sitl.vehicle import NoBinaryError, UnusableBinaryError, VehicleKind, VehicleType


def choose_vehicles(scenario: Scenario) -> dict[VehicleType, VehicleKind]:
    """The kind of each type of vehicle in use; empty: no vehicles.

    ArduPilot if the binaries of all types are found, else the embedded vehicle, unless the scenario says. Raises
    VehicleFailedError for a binary that will not do, MachineError if ArduPilot is asked for and not here.
    """
    vehicles = scenario.vehicles
    if vehicles.kind == "none":
        return {}
    types = dict.fromkeys(vehicles.type_of(vehicle) for vehicle in scenario.roster)
    embedded: dict[VehicleType, VehicleKind] = {vehicle_type: Embedded(vehicle_type) for vehicle_type in types}
    if vehicles.kind == "embedded":
        return embedded
    try:
        return {vehicle_type: ArduPilot.find(vehicles.binary, os.environ, vehicle_type) for vehicle_type in types}
    except NoBinaryError as error:
        if vehicles.kind == "ardupilot":
            raise MachineError(str(error)) from None
        return embedded
    except UnusableBinaryError as error:
        raise VehicleFailedError(str(error)) from None
