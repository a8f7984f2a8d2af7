"""Choose for each vehicle of a scenario between ArduPilot and the embedded vehicle model."""

import os

from harness.errors import MachineError
from harness.play.process._vehicle_process import VehicleFailedError
from harness.scenario import Scenario
from sitl.ardupilot import ArduPilot
from sitl.embedded import Embedded
from sitl.vehicle import NoBinaryError, NoProgramError, VehicleError, VehicleKind


def choose_vehicles(scenario: Scenario) -> dict[int, VehicleKind]:
    """Return the program of each vehicle.

    Return an empty result if the scenario has no vehicles. If the scenario does not name a kind of vehicle, and all
    ArduPilot binaries exist, all vehicles run ArduPilot. If a binary is missing, all vehicles use the embedded vehicle
    model. Raises VehicleFailedError for an unusable binary or an impossible vehicle set-up, and MachineError if a
    required program is missing.
    """
    vehicles = scenario.vehicles
    if vehicles.kind == "none":
        return {}
    try:
        kinds = _ardupilots(scenario) or {
            vehicle: Embedded(vehicles.type_of(vehicle), vehicles.setup_of(vehicle)) for vehicle in scenario.roster
        }
        for vehicle, kind in kinds.items():
            _check(vehicle, kind)
    except (NoBinaryError, NoProgramError) as error:
        raise MachineError(str(error)) from None
    except VehicleError as error:
        raise VehicleFailedError(str(error)) from None
    return kinds


def _ardupilots(scenario: Scenario) -> dict[int, VehicleKind] | None:
    """Return the ArduPilot program of each vehicle. Return None if the scenario uses the embedded vehicle model.

    Raises NoBinaryError if the scenario requires ArduPilot, and a binary is missing.
    """
    vehicles = scenario.vehicles
    if vehicles.kind == "embedded":
        return None
    try:
        return {
            vehicle: ArduPilot.find(vehicles.binary, os.environ, vehicles.type_of(vehicle), vehicles.setup_of(vehicle))
            for vehicle in scenario.roster
        }
    except NoBinaryError:
        if vehicles.kind == "ardupilot":
            raise
        return None


def _check(vehicle: int, kind: VehicleKind) -> None:
    try:
        kind.check()
    except VehicleError as error:
        raise type(error)(f"vehicle {vehicle}: {error}") from None
