"""Check before a run that the ground station named in the scenario can be reached."""

from harness.errors import ScenarioError
from harness.scenario import Scenario
from sitl.address import ListenAddress, connected
from sitl.vehicle import VehicleError


def refuse_unreachable_ground_station(scenario: Scenario) -> None:
    """Raise ScenarioError if the ground station cannot be reached, or if the scenario has no vehicles that the ground
    station could show.
    """
    if scenario.gcs is None:
        return
    if scenario.vehicles.kind == "none":
        raise ScenarioError(
            "a ground station needs vehicles, and `vehicles.kind` is none: leave out the ground "
            "station, or give another kind"
        )
    try:
        connected(ListenAddress.parse(scenario.gcs)).close()
    except VehicleError as error:
        raise ScenarioError(str(error)) from None
