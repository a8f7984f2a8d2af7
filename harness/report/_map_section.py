"""Draw the maps in the report: one map with the flight paths of the vehicles, and small maps that show the swarm at
important moments.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from harness.archive.connectivity import Connectivity, quality
from harness.archive.tracks import VehicleTracks
from harness.present import text
from harness.present.colours import AgentColours
from harness.report import map_svg
from harness.report.facts import link_qualities
from harness.report.map_parts import (
    MAX_SEGMENTS,
    FlightPath,
    GroundRectangle,
    NetworkDivision,
    divisions,
    extent,
    flights,
    letter,
    longest_divisions,
)
from harness.scenario.changes import RANGE
from sitl.vehicle import VehicleType

MOVES_M = 1.0
"""Distance in metres. A vehicle that moves by at most this distance to the north and to the east counts as standing
still.
"""
MOMENTS = 6


@dataclass(frozen=True, slots=True)
class MapMoment:
    """A small map that shows the swarm at one moment."""

    at: str
    """The time of the moment."""
    what: str
    """A text about the event at this time, or an empty text if there is no event."""
    network: str
    """The groups of connected vehicles at this time."""
    picture: Markup


@dataclass(frozen=True, slots=True)
class MapSection:
    """The map with its legend. If the map cannot be drawn, `tracks` is None and `notes` contains the reason."""

    tracks: Markup | None
    legend: list[tuple[Markup, str]]
    """The legend, as pairs of a sample and its meaning."""
    moments: list[MapMoment]
    notes: list[str]


def section(
    tracks: VehicleTracks, network: Connectivity, ink: Mapping[int, AgentColours], types: Mapping[int, VehicleType]
) -> MapSection | None:
    """Return the map section. Return None if no vehicle moved and no file is damaged. `types` maps vehicles to their
    types, if the types are known.
    """
    if not any(_has_moved(tracks, vehicle) for vehicle in tracks.by_vehicle):
        return MapSection(None, [], [], tracks.problems) if tracks.problems else None
    return _drawn(tracks, network, ink, types)


def _has_moved(tracks: VehicleTracks, vehicle: int) -> bool:
    fixes = tracks.by_vehicle[vehicle]
    return any(
        max(metres) - min(metres) > MOVES_M
        for metres in ([fix.north_m for fix in fixes], [fix.east_m for fix in fixes])
    )


def _drawn(
    tracks: VehicleTracks, network: Connectivity, ink: Mapping[int, AgentColours], types: Mapping[int, VehicleType]
) -> MapSection:
    end_s = max(fixes[-1].at_s for fixes in tracks.by_vehicle.values())
    known = [division for division in divisions(network.states) if division.at_s <= end_s]
    kept = longest_divisions(known, end_s, max(MAX_SEGMENTS // len(tracks.by_vehicle), 2))
    flown = [flight for vehicle in tracks.by_vehicle for flight in flights(vehicle, tracks, network, kept, end_s)]
    area_extent = extent([fix for fixes in tracks.by_vehicle.values() for fix in fixes])
    reboots = [(tracks.at(vehicle, at_s), vehicle) for at_s, vehicle in network.reboots if at_s <= end_s]
    moments = [
        _moment(at_s, division, tracks, network, flown, area_extent, ink, types)
        for at_s, division in _notable_moments(known, network, tracks, end_s)
    ]
    notes = [*tracks.problems, *network.problems]
    if not known:
        notes.append("network.jsonl: the network conditions are not recorded")
    elif len(kept) < len(known):
        notes.append(f"network.jsonl: the map shows the {len(kept) - 1} longest of {len(known) - 1} network states")
    return MapSection(
        map_svg.draw_tracks(flown, reboots, area_extent, ink, _description(tracks, area_extent, moments)),
        [*_legend(flown, rebooted=bool(reboots)), *_legend_of_moments(moments, set(types.values()))],
        moments,
        notes,
    )


def _notable_moments(
    known: Sequence[NetworkDivision], network: Connectivity, tracks: VehicleTracks, end_s: float
) -> list[tuple[float, NetworkDivision | None]]:
    """Return up to `MOMENTS` + 1 moments that the report shows on small maps. Each moment comes with the groups of
    vehicles that are connected at that time.

    The moments are the start, the end, the most important network changes and the time of the worst losses. The
    importance of a change is the number of affected vehicles multiplied by the duration of the new state.
    """
    begin_s = min(fixes[0].at_s for fixes in tracks.by_vehicle.values())
    ends = [*(division.at_s for division in known[1:]), end_s]
    weights = {}
    for before, division, until_s in zip(known, known[1:], ends[1:], strict=False):
        if division.at_s > begin_s:
            weights[division.at_s] = division.changed_since(before) * (until_s - division.at_s)
    changes = sorted(weights, key=lambda at_s: -weights[at_s])[: MOMENTS - 2]
    lossy = max(network.losses, key=lambda losses: losses.mean, default=None)
    worst = [lossy.at_s] if lossy and quality(lossy.mean) and begin_s < lossy.at_s < end_s else []
    moments = sorted({begin_s, *changes, *worst, end_s})
    return [(at_s, next((division for division in reversed(known) if division.at_s <= at_s), None)) for at_s in moments]


def _moment(
    at_s: float,
    division: NetworkDivision | None,
    tracks: VehicleTracks,
    network: Connectivity,
    flown: Sequence[FlightPath],
    area_extent: GroundRectangle,
    ink: Mapping[int, AgentColours],
    types: Mapping[int, VehicleType],
) -> MapMoment:
    living = set(ink) if division is None else division.living
    seen = {vehicle: tracks.at(vehicle, at_s) for vehicle in sorted(living) if vehicle in tracks.by_vehicle}
    links = network.links(at_s) if division else []
    lost = [flight.end for flight in flown if flight.lost and flight.end.at_s <= at_s and flight.vehicle not in living]
    what = division.what if division and division.at_s == at_s and division.what not in (RANGE, "start") else ""
    state = "network not recorded" if division is None else division.in_words()
    losses = {pair: network.loss(pair, at_s) for pair in links if pair[0] in seen and pair[1] in seen}
    if lossy := _in_words(losses.values()):
        state += f", {lossy}"
    at = text.duration(round(at_s, 1))
    picture = map_svg.draw_moment(
        seen,
        lost,
        losses,
        division,
        area_extent,
        ink,
        types,
        f"The swarm at {at}: {state}",
    )
    return MapMoment(at, what, state, picture)


def _legend(flown: Sequence[FlightPath], *, rebooted: bool) -> list[tuple[Markup, str]]:
    """Return a legend for the marks that this map contains."""
    parts: dict[str, set[int]] = {}
    for flight in flown:
        for segment in flight.segments:
            part = segment.division.part_of(flight.vehicle) if segment.division else None
            parts.setdefault(map_svg.css_class(segment.division, flight.vehicle), set()).update(
                () if part is None else (part,)
            )
    means = {
        "whole": "connected to all others",
        "unknown": "network not recorded",
        "alone": "disconnected from all others",
    }
    entries = [
        (which, means.get(which) or f"part {', '.join(map(letter, sorted(parts[which])))}")
        for which in map_svg.TRACK_CLASSES
        if which in parts
    ]
    entries += [("start", "start"), ("end", "end")]
    entries += [("lost", "lost")] if any(flight.lost for flight in flown) else []
    entries += [("reboot", "agent reboots")] if rebooted else []
    return [(map_svg.sample(which), meaning) for which, meaning in entries]


def _in_words(losses: Collection[float]) -> str:
    """Describe the losses of the links by the smallest and the largest loss rate. Return an empty text if both are
    negligible.
    """
    least, most = min(losses, default=0.0), max(losses, default=0.0)
    if not quality(most):
        return ""
    low, high = text.percent(least), text.percent(most)
    return f"links lose {high}" if low == high else f"links lose {low} to {high}"


def _legend_of_moments(moments: Sequence[MapMoment], types: set[VehicleType]) -> list[tuple[Markup, str]]:
    """Return the part of the legend that explains links with losses. If the swarm has several types of vehicles, this
    part also explains the shape of each type.
    """
    drawn = "".join(moment.picture for moment in moments)
    entries = [
        (map_svg.sample(f"q{which}"), words)
        for which, words in enumerate(link_qualities())
        if which and f" q{which}" in drawn
    ]
    shapes = sorted(types) if len(types) > 1 else []
    return entries + [(map_svg.sample(vehicle_type), vehicle_type) for vehicle_type in shapes]


def _description(tracks: VehicleTracks, area_extent: GroundRectangle, moments: Sequence[MapMoment]) -> str:
    """Return a text that describes the map for readers who cannot see it."""
    count = len(tracks.by_vehicle)
    states = "; ".join(
        f"at {moment.at}{f', {moment.what}' if moment.what else ''}: {moment.network}" for moment in moments
    )
    vehicles = f"{count} vehicles" if count > 1 else "1 vehicle"
    area = f"{area_extent.width_m:.0f} m from west to east, {area_extent.height_m:.0f} m from south to north"
    return f"{vehicles}; {area}; {states}."
