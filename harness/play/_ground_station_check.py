"""Whether a scenario's ground station can be reached, found out before anything starts."""

from harness.errors import ScenarioError
from harness.scenario import Scenario
from sitl.address import Address, connected
from sitl.vehicle import VehicleError


def refuse_unreachable_ground_station(scenario: Scenario) -> None:
    """Raises ScenarioError if there is no way to the scenario's ground station, or nothing for it to see."""
    if scenario.gcs is None:
        return
    if scenario.vehicles.kind == "none":
        raise ScenarioError(
            "a ground station needs vehicles, and `vehicles.kind` is none: leave out the ground "
            "station, or give another kind"
        )
    try:
        connected(Address.parse(scenario.gcs)).close()
    except VehicleError as error:
        raise ScenarioError(str(error)) from None
