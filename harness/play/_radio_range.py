"""Compute the network conditions from the timeline of the scenario and from the radio losses at the vehicles'
positions.

All backends use this module, so the same flight gives the same network. Without a radio in the scenario, the positions
have no effect.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import product

from harness.scenario import Scenario
from harness.scenario.changes import RANGE, NetworkChange
from netem import radio
from netem.conditions import NetworkConditions
from netem.radio import Place
from sitl.track import VehicleTrack, track
from sitl.vehicle import place_in_field

TRACK_S = 1.0
"""Mission seconds between two recorded positions of the vehicles, unless the radio sets another interval."""


class RadioRange:
    """The current network conditions of one run. They follow from the timeline of the scenario and from the positions
    of the vehicles.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._roster = scenario.roster
        model = scenario.network.radio
        self._radio: radio.Radio | None = model.radio() if model else None
        self._requested = NetworkConditions()
        self._losses: dict[frozenset[int], float] = {}
        self._cut_off: frozenset[int] = frozenset()

    def change_timeline(self, change: NetworkChange) -> NetworkChange:
        """Return the change of the network that a timeline entry causes. The new conditions include the radio losses at
        the current positions of the vehicles.
        """
        self._requested = change.conditions
        if change.clears_all:
            self._radio = None
        return replace(change, losses=self._set_losses({}) if change.clears_all else {}, conditions=self._conditions())

    def move(self, at_s: float, places: Mapping[int, Place]) -> NetworkChange | None:
        """Move the vehicles to these positions. Return the resulting change of the network, or None if this does not
        change the network.
        """
        if self._radio is None:
            return None
        losses = radio.links(self._radio, places)
        before = self._losses
        changed = self._set_losses(losses)
        if self._losses == before:
            return None
        conditions = self._conditions()
        return NetworkChange(
            at_s, RANGE, groups_text(radio.components(conditions, self._roster)), conditions, losses=changed
        )

    def cut_off(self, at_s: float, vehicles: frozenset[int]) -> NetworkChange:
        """Cut off these vehicles from the network. Connect vehicles that were cut off before and are not in the list.
        Return the change of the network.
        """
        radio_losses = {pair: loss for pair, loss in self._losses.items() if not pair & self._cut_off}
        self._cut_off = vehicles
        changed = self._set_losses(radio_losses)
        conditions = self._conditions()
        groups = groups_text(radio.components(conditions, self._roster))
        return NetworkChange(at_s, RANGE, groups, conditions, losses=changed)

    def _set_losses(self, losses: dict[frozenset[int], float]) -> dict[str, float]:
        """Set the radio losses. Return the losses that changed, with keys such as "1-3" for a pair of vehicles."""
        cut = (frozenset(pair) for vehicle in self._cut_off for pair in product((vehicle,), self._roster))
        losses = losses | {pair: 1.0 for pair in cut if len(pair) == 2}
        changed = {pair for pair in losses.keys() | self._losses.keys() if losses.get(pair) != self._losses.get(pair)}
        self._losses = losses
        return {"-".join(map(str, sorted(pair))): losses.get(pair, 0.0) for pair in sorted(changed, key=sorted)}

    def _conditions(self) -> NetworkConditions:
        return radio.over_the_air(self._requested, self._losses)


def groups_text(components: Iterable[Iterable[int]]) -> str:
    """Return the groups of connected vehicles as text, such as "1 2 3 | 4 5"."""
    return " | ".join(" ".join(map(str, sorted(component))) for component in components)


def tracks_of(scenario: Scenario) -> dict[int, VehicleTrack]:
    """Return the flight path of each vehicle in virtual time. The result is empty if no key of the scenario (flight,
    radio, channel or ground station) needs positions.
    """
    if not (scenario.flight or scenario.network.radio or scenario.network.channel or scenario.gcs):
        return {}
    return {vehicle: track_of(scenario, vehicle) for vehicle in scenario.roster}


def track_of(scenario: Scenario, vehicle: int) -> VehicleTrack:
    """Return the computed flight path of a vehicle that takes off at mission second 0."""
    vehicles, flight = scenario.vehicles, scenario.flight_of(vehicle)
    index = scenario.roster.index(vehicle)
    if index in vehicles.swarm or vehicle in vehicles.each:
        home = vehicles.home_of(vehicle, index)
        north_m, east_m, up_m = vehicles.field.metres_to(home.lat_deg, home.lon_deg, home.alt_m)
    else:  # without rounding through degrees
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
