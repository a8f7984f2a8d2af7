"""Test the map: flight paths, groups of connected vehicles, and descriptions.

Test the geometry of the map: north is up, both axes have one scale, and simplified lines look the same.
"""

import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.archive.archive import RunArchive
from harness.archive.connectivity import NETWORK_FILE, Topology, read_connectivity
from harness.archive.tracks import TRACKS_FILE, PositionFix, read_tracks
from harness.present.colours import AgentColours, inks
from harness.report import _map_section, write_report
from harness.report._map_section import MapSection
from harness.report.map_parts import (
    INVISIBLE_PX,
    GroundRectangle,
    MapProjection,
    Point,
    divisions,
    extent,
    letter,
    longest_divisions,
    simplify,
    thin,
)
from harness.scenario import Scenario
from sitl.vehicle import VehicleType
from tests.harness.report.flights import Way, split_and_rejoin, still, write_flight, write_lines
from tests.harness.report.runs import write_run
from tests.harness.report.test_page import Reader

FIVE = range(1, 6)
SVG = "{http://www.w3.org/2000/svg}"


def scenario(range_m: float = 250.0, **more: Any) -> Scenario:
    network = {"radio": {"hard_range": {"range_m": range_m}}}
    return Scenario.model_validate({"name": "split", "duration_s": 1200, "network": network} | more)


def drawn(run_dir: Path, seconds: int = 600, tracks: dict[int, Way] | None = None, **more: Any) -> MapSection:
    tracks = tracks or {vehicle: split_and_rejoin(vehicle) for vehicle in FIVE}
    write_flight(run_dir, scenario(agents=len(tracks), **more), tracks, seconds)
    section = section_of(run_dir, inks(tracks))
    assert section is not None
    return section


def section_of(run_dir: Path, ink: dict[int, AgentColours]) -> MapSection | None:
    network = read_connectivity(run_dir / NETWORK_FILE, ink)
    return _map_section.section(read_tracks(run_dir / TRACKS_FILE, ink), network, ink, {})


def paths(section: MapSection) -> list[tuple[str, str, list[tuple[float, float]]]]:
    """Return the class, tooltip and points of all paths on the map."""
    found = []
    for path in ElementTree.fromstring(str(section.tracks)).iter(f"{SVG}path"):  # noqa: S314 - ours
        if path.get("class", "").startswith("way "):
            points = [tuple(map(float, pair.split())) for pair in re.split("[ML]", path.get("d", "")) if pair]
            found.append((path.get("class", "").removeprefix("way "), path.findtext(f"{SVG}title") or "", points))
    return found  # type: ignore[return-value]


def said(section: MapSection) -> list[str]:
    return [" ".join(filter(None, (one.at, one.what, one.network))).replace("\u00a0", " ") for one in section.moments]


def state(at_s: float, *components: set[int]) -> Topology:
    return Topology(at_s, "range", tuple(frozenset(component) for component in components))


def test_map_shows_the_parts_of_a_split_and_a_rejoin(tmp_path: Path) -> None:
    section = drawn(tmp_path)
    assert [which for _, which in section.legend] == ["connected to all others", "part A", "part B", "start", "end"]
    tracks = paths(section)
    assert sum(which == "part0" for which, _, _ in tracks) == 3
    assert sum(which == "part1" for which, _, _ in tracks) == 2
    (second,) = [tip for which, tip, _ in tracks if which == "part0" and tip.startswith("vehicle 2")]
    assert second.endswith("part A, with 1, 3")
    assert all("connected to all others" in tip for which, tip, _ in tracks if which == "whole")


def test_maps_show_begin_changes_and_end_with_the_live_links(tmp_path: Path) -> None:
    section = drawn(tmp_path)
    (begin, apart, together, end) = said(section)
    assert begin == "0 s all 5 connected"
    assert apart.endswith("s A 1\u20133; B 4, 5")
    assert together.endswith("s all 5 connected")
    assert end == "600 s all 5 connected"
    links = [re.findall('class="link ([a-z0-9]+) q0"', one.picture) for one in section.moments]
    assert links == [["whole"], ["part0", "part1"], ["whole"], ["whole"]]


def test_links_are_drawn_and_described_by_their_loss(tmp_path: Path) -> None:
    """All vehicles are connected, but they lose most of the messages."""
    section = drawn(tmp_path, network={"loss": 0.98, "radio": {"hard_range": {"range_m": 2000}}})
    assert said(section)[0] == "0 s all 5 connected, links lose 98 %"
    assert 'class="link whole q3"' in section.moments[0].picture
    assert "link that loses 60\u00a0% to 100\u00a0%" in [meaning for _, meaning in section.legend]


def test_each_type_of_vehicle_has_its_shape(tmp_path: Path) -> None:
    drawn(tmp_path)
    ink, network = inks(FIVE), read_connectivity(tmp_path / NETWORK_FILE, FIVE)
    types: dict[int, VehicleType] = {1: "copter", 2: "plane", 3: "rover", 4: "copter", 5: "copter"}
    section = _map_section.section(read_tracks(tmp_path / TRACKS_FILE, ink), network, ink, types)
    assert section is not None
    assert [meaning for _, meaning in section.legend][-3:] == ["copter", "plane", "rover"]
    shapes = re.findall(r'class="dot whole" d="(.*?)".*?<title>vehicle (\d)', section.moments[0].picture)
    kinds = {int(vehicle): re.sub(r"[\d. -]", "", shape) for shape, vehicle in shapes}
    assert kinds[1] == kinds[4] and len(set(kinds.values())) == 3


def test_known_track_gives_the_known_path(tmp_path: Path) -> None:
    """A flight around a square of 200 m leads north, east, south and west. The map shows it as up, right, down and
    left.
    """

    def square(at_s: float) -> tuple[float, float]:
        side, along = int(at_s // 50) % 4, at_s % 50 * 4
        return [(along, 0.0), (200.0, along), (200 - along, 200.0), (0.0, 200 - along)][side]

    section = drawn(tmp_path, 200, {1: square, 2: still(100, 100)}, range_m=1000)
    (points,) = [points for _, tip, points in paths(section) if tip.startswith("vehicle 1")]
    (x0, y0), (x1, y1), (x2, y2), (x3, y3), back = points
    assert (x0, y0) == back
    assert (x0, y1, x2, y3) == (x1, y2, x3, y0)
    assert y1 < y0
    assert x2 > x1
    side = y0 - y1
    assert x2 - x1 == pytest.approx(side, abs=0.11)
    bar = re.search(r'class="bar" d="M[\d.]+ [\d.]+v5h([\d.]+)v-5"', str(section.tracks))
    metres = re.search(r">(\d+)\u00a0m</text>", str(section.tracks))
    assert bar
    assert metres
    assert float(bar[1]) / int(metres[1]) == pytest.approx(side / 200, rel=0.01)


def test_vehicle_out_of_range_is_alone_from_that_place(tmp_path: Path) -> None:
    tracks = {1: still(0, 0), 2: still(10, 0), 3: lambda at_s: (0.0, 2 * at_s)}
    section = drawn(tmp_path, 200, tracks)
    ((_, tip, points),) = [way for way in paths(section) if way[0] == "alone"]
    assert tip.replace("\u00a0", " ") == "vehicle 3, 126 s to 200 s: alone"
    ((_, _, before),) = [way for way in paths(section) if way[0] == "whole" and way[1].startswith("vehicle 3")]
    assert before[-1] == points[0]
    assert (points[0][0] - before[0][0]) / (points[-1][0] - before[0][0]) == pytest.approx(126 / 200, abs=0.01)
    assert said(section)[1] == "126 s A 1, 2; alone 3"


def test_track_changes_colour_at_the_interpolated_position(tmp_path: Path) -> None:
    timeline = [{"at_s": 50.25, "partition": [[1]]}, {"at_s": 50.75, "heal": True}]
    tracks: dict[int, Way] = {1: lambda at_s: (at_s, 0.0), 2: lambda at_s: (0.0, at_s)}
    flown = paths(drawn(tmp_path, 100, tracks, timeline=timeline))
    (alone,) = [points for which, tip, points in flown if which == "alone" and tip.startswith("vehicle 1")]
    before, after = [points for which, tip, points in flown if which == "whole" and tip.startswith("vehicle 1")]
    assert (alone[0], alone[-1]) == (before[-1], after[0])
    up = before[0][1] - after[-1][1]
    assert (before[0][1] - alone[0][1]) / up == pytest.approx(0.5025, abs=0.001)
    assert (before[0][1] - alone[-1][1]) / up == pytest.approx(0.5075, abs=0.001)


def test_lost_vehicle_ends_in_a_cross_and_its_successor_begins_at_home(tmp_path: Path) -> None:
    timeline = [
        {"at_s": 50, "kill": [2]},
        {"at_s": 100, "restart": [2]},
        {"at_s": 120, "reboot": [1], "down_s": 10, "disk": "kept"},
    ]

    def killed(at_s: float) -> tuple[float, float]:
        return (min(at_s, 50.0), 0.0) if at_s <= 101 else (0.0, at_s - 102)

    tracks: dict[int, Way] = {1: still(0, 5), 2: killed}
    section = drawn(tmp_path, 150, tracks, timeline=timeline)
    tips = [tip.replace("\u00a0", " ") for tip in re.findall("<title>([^<]*)</title>", str(section.tracks))]
    assert "vehicle 2 is lost at 50 s" in tips
    assert "vehicle 2 starts at 102 s" in tips
    assert "agent 1 reboots at 120 s" in tips
    assert str(section.tracks).count('class="lost"') == 1
    assert {"lost", "agent reboots"} <= {meaning for _, meaning in section.legend}
    assert said(section)[1:3] == ["50 s kill 1 vehicle", "100 s restart all 2 connected"]
    assert ['class="lost"' in one.picture for one in section.moments] == [False, True, False, False]


def test_parts_keep_their_letters_while_most_of_them_stay() -> None:
    found = divisions(
        [
            state(0, {1, 2, 3, 4, 5, 6, 7}),
            state(10, {1, 2, 3, 4}, {5, 6, 7}),
            state(20, {5, 6, 7, 4}, {1, 2, 3}),
            state(30, {1, 2, 3, 4, 5, 6, 7}),
            state(35, *({vehicle} for vehicle in range(1, 8))),
            state(40, {4, 5, 6, 7}, {2, 3}, {1}),
            state(50, {1, 6}, {2, 3}, {4, 5}, {7}),
            state(60),
        ]
    )
    assert [division.in_words() for division in found] == [
        "all 7 connected",
        "A 1\u20134; B 5\u20137",
        "A 1\u20133; B 4\u20137",
        "all 7 connected",
        "alone 1\u20137",
        "A 2, 3; B 4\u20137; alone 1",
        "A 2, 3; B 1, 6; C 4, 5; alone 7",
        "no vehicle left",
    ]
    assert [letter(number) for number in (0, 25, 26, 53)] == ["A", "Z", "A2", "B3"]


def test_longest_divisions_are_kept_if_there_are_too_many() -> None:
    found = divisions([state(at_s, {1, 2}, {3 + at}) for at, at_s in enumerate((0, 1, 10, 12, 30))])
    assert [one.at_s for one in longest_divisions(found, 40, 3)] == [0, 12, 30]
    assert longest_divisions(found, 40, 5) == found


def test_at_most_six_moments_are_shown_the_longest_among_them(tmp_path: Path) -> None:
    timeline = [
        entry
        for at_s, until_s in ((100, 110), (200, 290), (300, 310), (400, 405), (500, 590))
        for entry in ({"at_s": at_s, "partition": [[1, 2]]}, {"at_s": until_s, "heal": True})
    ]
    section = drawn(tmp_path, 600, {1: still(0, 0), 2: still(9, 9), 3: split_and_rejoin(1)}, timeline=timeline)
    assert len(section.moments) == 6
    assert {"200 s partition A 1, 2; alone 3", "500 s partition A 1, 2; alone 3"} <= set(said(section))
    assert not [one for one in said(section) if one.startswith("400 s")]


def test_description_of_the_map_names_its_moments(tmp_path: Path) -> None:
    tracks = str(drawn(tmp_path).tracks)
    described = re.search('<desc id="tracks-desc">([^<]*)</desc>', tracks)
    assert described
    assert described[1].startswith("5 vehicles; ")
    assert "at 0\u00a0s: all 5 connected; at " in described[1]
    assert "A 1\u20133; B 4, 5" in described[1]


def test_twenty_minutes_of_five_stay_small_and_fifty_within_bounds(tmp_path: Path) -> None:
    five = drawn(tmp_path, 1200)
    assert len(str(five.tracks)) + sum(len(one.picture) for one in five.moments) < 60_000

    def way(vehicle: int) -> Way:
        return lambda at_s: (
            at_s * math.cos(vehicle) / 3 + 60 * math.sin(at_s / 7),
            at_s * math.sin(vehicle) / 3 + 60 * math.cos(at_s / (5 + vehicle % 3)),
        )

    fifty = drawn(tmp_path, 120, {vehicle: way(vehicle) for vehicle in range(1, 51)}, range_m=80)
    assert sum(len(points) for _, _, points in paths(fifty)) <= 20_000
    assert len(str(fifty.tracks)) + sum(len(one.picture) for one in fifty.moments) < 2_000_000


@pytest.fixture
def ink() -> dict[int, AgentColours]:
    return inks(FIVE)


def test_run_without_movement_or_tracks_has_no_map(tmp_path: Path, ink: dict[int, AgentColours]) -> None:
    assert section_of(tmp_path, ink) is None
    write_flight(tmp_path, scenario(agents=5), {vehicle: still(vehicle, 0) for vehicle in FIVE}, 5)
    assert section_of(tmp_path, ink) is None


def test_tracks_without_network_record_are_drawn_with_a_note(tmp_path: Path, ink: dict[int, AgentColours]) -> None:
    write_lines(tmp_path / TRACKS_FILE, [{"at_s": at, "places": {"3": [at * 9, 0, 0]}} for at in range(3)])
    section = section_of(tmp_path, ink)
    assert section is not None
    assert [which for which, _, _ in paths(section)] == ["unknown"]
    assert section.notes == ["network.jsonl: the network conditions are not recorded"]
    assert "link" not in section.moments[0].picture


def test_damaged_tracks_leave_a_sentence_on_the_page(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", {1: "1.1", 2: "1.1"})
    (run_dir / TRACKS_FILE).write_text('{\n{"at_s": 1, "places": {"<script>": [0, 0, 0]}}\n')
    page = Reader(write_report(RunArchive(run_dir)).read_text(encoding="utf-8"))
    assert "tracks.jsonl: 2 damaged or unknown lines are left out." in page.text
    assert "map" not in {attributes.get("class") for tag, attributes in page.elements if tag == "svg"}


def test_texts_from_the_record_stay_text(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", {1: "1.1", 2: "1.1"})
    write_flight(run_dir, scenario(agents=2), {1: still(0, 0), 2: split_and_rejoin(2)}, 20)
    record = run_dir / "network.jsonl"
    asked = {"at_s": 10.0, "what": "<script>alert(1)</script>", "asked": {"partition": [[1]]}}
    write_lines(tmp_path / "more", [asked])
    record.write_text(record.read_text() + (tmp_path / "more").read_text())
    page = write_report(RunArchive(run_dir)).read_text(encoding="utf-8")
    assert "<script" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    identifiers = re.findall(r' id="([^"]+)"', page)
    assert len(identifiers) == len(set(identifiers))


LAND = GroundRectangle(south_m=-100, north_m=100, west_m=-200, east_m=200)
TO_PX = MapProjection(LAND, 10, 20, 800, 600)

places = st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)), min_size=1, max_size=20)
lines = st.lists(st.tuples(st.floats(0, 900), st.floats(0, 600)), min_size=2, max_size=60)


def test_north_is_up_east_is_right_and_metres_have_equal_lengths() -> None:
    assert TO_PX(PositionFix(0, 100, -200)) == (10, 20)
    assert TO_PX(PositionFix(0, -100, 200)) == (810, 420)
    assert TO_PX(PositionFix(0, 0, 0)) == (410, 220)
    assert TO_PX(PositionFix(0, 50, 0)) == (410, 120)
    assert TO_PX(PositionFix(0, 0, 50)) == (510, 220)


def test_land_of_any_shape_fits_into_its_rectangle() -> None:
    for land in (LAND, GroundRectangle(-500, 500, -10, 10), GroundRectangle(0, 30, 0, 30)):
        to_px = MapProjection(land, 0, 0, 800, 600)
        assert to_px.width <= 800 + 1e-9
        assert to_px.height <= 600 + 1e-9
        assert max(to_px.width / 800, to_px.height / 600) == pytest.approx(1)


def test_ticks_and_scale_bar_are_round_metres() -> None:
    north, east = TO_PX.ticks_m()
    assert north == [-100, -50, 0, 50, 100]
    assert east == [-200, -150, -100, -50, 0, 50, 100, 150, 200]
    assert TO_PX.scale_bar_m() == 100
    assert MapProjection(GroundRectangle(0, 1000, 0, 1100), 0, 0, 800, 600).scale_bar_m() == 250


@given(places)
def test_all_tracks_are_inside_the_map_with_a_margin(flown: list[tuple[float, float]]) -> None:
    land = extent([PositionFix(0, *place) for place in flown])
    for north_m, east_m in flown:
        assert land.south_m < north_m < land.north_m
        assert land.west_m < east_m < land.east_m
    assert 0.44 < land.width_m / land.height_m < 1 / 0.44


def test_swarm_that_hardly_moves_is_not_enlarged() -> None:
    land = extent([PositionFix(0, 0, 0), PositionFix(1, 0.5, 0)])
    assert land.width_m == land.height_m == pytest.approx(22)


def test_straight_line_is_reduced_to_its_ends_and_corners_stay() -> None:
    straight = [(float(x), 2.0 * x) for x in range(100)]
    assert simplify(straight, INVISIBLE_PX) == [(0, 0), (99, 198)]
    assert simplify([*straight, (99, 0)], INVISIBLE_PX) == [(0, 0), (99, 198), (99, 0)]
    assert simplify([(5, 5), (5.1, 5), (5, 5.1), (5, 5)], INVISIBLE_PX) == [(5, 5), (5, 5)]


@given(lines, st.floats(0.1, 20))
def test_no_point_is_farther_from_the_thinned_line_than_the_tolerance(line: list[Point], tolerance: float) -> None:
    thin = simplify(line, tolerance)
    assert (thin[0], thin[-1]) == (line[0], line[-1])
    assert set(thin) <= set(line)
    for point in line:
        assert min(_distance(point, *ends) for ends in pairwise(thin)) <= tolerance + 1e-6


def _distance(point: Point, start: Point, end: Point) -> float:
    """Return the distance of a point from a line. The function tries points along the line and does not use the tested
    code.
    """
    low, high = 0.0, 1.0

    def at(share: float) -> float:
        return math.dist(point, [one + share * (other - one) for one, other in zip(start, end, strict=True)])

    for _ in range(60):
        third = (high - low) / 3
        low, high = (low, high - third) if at(low + third) < at(high - third) else (low + third, high)
    return min(at(low), at(0), at(1))


def test_many_points_are_thinned_to_the_bound_but_no_line_loses_its_ends() -> None:
    zigzag = [[(float(x % 700), float((x * 7919 + shift) % 500)) for x in range(600)] for shift in range(3)]
    lines = thin(zigzag, 200)
    assert sum(map(len, lines)) <= 200
    assert [(line[0], line[-1]) for line in lines] == [(line[0], line[-1]) for line in zigzag]
    assert thin(zigzag, 0) == [[line[0], line[-1]] for line in zigzag]
