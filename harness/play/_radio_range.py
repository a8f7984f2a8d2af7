"""Who reaches whom: what the timeline asks of the network, and what the radio loses over the distances flown.

Both backends ask it, so the same flight makes the same network. Without a radio in the scenario places change nothing.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

from harness.scenario import Scenario
from harness.scenario.changes import RANGE, NetworkChange
from netem import radio
from netem.conditions import NetworkConditions
from netem.radio import Place
from sitl.track import Track, track
from sitl.vehicle import place_in_field

TRACK_S = 1.0
"""Mission seconds between two looks at where the vehicles are, where no radio asks for another time."""


class RadioRange:
    """The network of one run as it stands."""

    def __init__(self, scenario: Scenario) -> None:
        self._roster = scenario.roster
        model = scenario.network.radio
        self._radio: radio.Radio | None = model.radio() if model else None
        self._asked = NetworkConditions()
        self._losses: dict[frozenset[int], float] = {}

    def ask(self, change: NetworkChange) -> NetworkChange:
        """The timeline makes this change: what it comes to at the places where the vehicles are."""
        self._asked = change.conditions
        if change.clears_all:
            self._radio = None
        return replace(change, losses=self._lose({}) if change.clears_all else {}, conditions=self._conditions())

    def move(self, at_s: float, places: Mapping[int, Place]) -> NetworkChange | None:
        """The vehicles are here now; what that changes, if anything."""
        if self._radio is None:
            return None
        losses = radio.links(self._radio, places)
        if losses == self._losses:
            return None
        changed = self._lose(losses)
        conditions = self._conditions()
        return NetworkChange(
            at_s, RANGE, in_words(radio.components(conditions, self._roster)), conditions, losses=changed
        )

    def _lose(self, losses: dict[frozenset[int], float]) -> dict[str, float]:
        """From now on the radio loses this; what has changed of it, by pair."""
        changed = {pair for pair in losses.keys() | self._losses.keys() if losses.get(pair) != self._losses.get(pair)}
        self._losses = losses
        return {"-".join(map(str, sorted(pair))): losses.get(pair, 0.0) for pair in sorted(changed, key=sorted)}

    def _conditions(self) -> NetworkConditions:
        return radio.over_the_air(self._asked, self._losses)


def in_words(components: Iterable[Iterable[int]]) -> str:
    """Who is connected: "1 2 3 | 4 5"."""
    return " | ".join(" ".join(map(str, sorted(component))) for component in components)


def tracks_of(scenario: Scenario) -> dict[int, Track]:
    """How the vehicles fly in virtual time; none do where no plan, radio or ground station asks where they are."""
    if not (scenario.flight or scenario.network.radio or scenario.network.channel or scenario.gcs):
        return {}
    return {vehicle: _track(scenario, vehicle, index) for index, vehicle in enumerate(scenario.roster)}


def _track(scenario: Scenario, vehicle: int, index: int) -> Track:
    vehicles, flight = scenario.vehicles, scenario.flight_of(vehicle)
    if index in vehicles.swarm or vehicle in vehicles.each:
        home = vehicles.home_of(vehicle, index)
        north_m, east_m, up_m = vehicles.field.metres_to(home.lat_deg, home.lon_deg, home.alt_m)
    else:  # as it was meant, and not by way of degrees
        home, up_m = vehicles.field, 0.0
        north_m, east_m = place_in_field(index, vehicles.spacing_m)
    return track(
        vehicles.type_of(vehicle),
        flight.to_plan() if flight else None,
        (north_m, east_m, up_m),
        heading_deg=home.heading_deg,
        takeoff_altitude_m=vehicles.takeoff_altitude_m,
        by=flight.by if flight else "mission",
    )
