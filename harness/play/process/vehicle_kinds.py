"""Which kind of vehicle flies for each vehicle of a scenario: ArduPilot, or the embedded vehicle."""

import os

from harness.errors import MachineError
from harness.play.process._vehicle_process import VehicleFailedError
from harness.scenario import Scenario
from sitl.ardupilot import ArduPilot
from sitl.embedded import Embedded
from sitl.vehicle import NoBinaryError, NoProgramError, VehicleError, VehicleKind


def choose_vehicles(scenario: Scenario) -> dict[int, VehicleKind]:
    """The kind of each vehicle; empty: no vehicles.

    ArduPilot if the binaries of all are found, else the embedded vehicle, unless the scenario says. Raises
    VehicleFailedError for a binary, or for what is asked of a vehicle, that will not do, MachineError if a program is
    asked for and not here.
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
    """Raises NoBinaryError if they are asked for, or have to fly a frame of their own, and are not here."""
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
