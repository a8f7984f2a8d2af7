"""Test which vehicles are connected, according to the recorded changes of the network.

Test the recorded positions of vehicles in complete, damaged and hostile files.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from harness.archive import bounded_file
from harness.archive.connectivity import NETWORK_FILE, Connectivity, read_connectivity
from harness.archive.directory import TRACKS_FILE
from harness.archive.tracks import PositionFix, read_tracks
from harness.play._radio_range import groups_text
from harness.scenario import Scenario
from tests.harness.report.flights import still, write_flight, write_lines

ALL = {"default": {"loss": 0.0}}


def network(directory: Path, *lines: dict[str, Any], vehicles: int = 4) -> Connectivity:
    write_lines(directory / NETWORK_FILE, [{"at_s": 0.0, "what": "start", "asked": ALL}, *lines])
    return read_connectivity(directory / NETWORK_FILE, range(1, vehicles + 1))


def states_of(connectivity: Connectivity) -> list[tuple[float, str, str]]:
    return [(state.at_s, state.what, groups_text(state.components)) for state in connectivity.states]


def out_of_range(at_s: float, *pairs: str, loss: float = 1.0) -> dict[str, Any]:
    return {"at_s": at_s, "what": "range", "losses": dict.fromkeys(pairs, loss)}


def partition(at_s: float, *groups: list[int]) -> dict[str, Any]:
    return {"at_s": at_s, "what": "partition", "asked": {**ALL, "partition": list(groups)}}


def test_partition_separates_and_heal_joins_components(tmp_path: Path) -> None:
    heal = {"at_s": 20.0, "what": "heal", "asked": ALL}
    found = network(tmp_path, partition(10.0, [1, 2]), heal)
    assert states_of(found) == [(0.0, "start", "1 2 3 4"), (10.0, "partition", "1 2 | 3 4"), (20.0, "heal", "1 2 3 4")]
    assert found.links(9.9) == [(1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4)]
    assert found.links(10.0) == [(1, 2), (3, 4)]
    assert len(found.links(20.0)) == 6


def test_state_without_duration_is_left_out(tmp_path: Path) -> None:
    heal = {"at_s": 10.0, "what": "heal", "asked": ALL}
    assert states_of(network(tmp_path, partition(10.0, [1, 2]), heal)) == [(0.0, "start", "1 2 3 4")]
    assert states_of(network(tmp_path, out_of_range(0.0, "1-2", "1-3", "1-4"))) == [(0.0, "range", "2 3 4 | 1")]


def test_relayed_vehicles_are_connected_and_loss_cuts_no_link(tmp_path: Path) -> None:
    found = network(tmp_path, out_of_range(5.0, "1-3", "1-4", "2-4"), out_of_range(9.0, "1-2", loss=0.99))
    assert states_of(found) == [(0.0, "start", "1 2 3 4")]
    assert found.links(9.0) == [(1, 2), (2, 3), (3, 4)]


def test_pair_without_one_direction_has_no_link(tmp_path: Path) -> None:
    asked = {**ALL, "links": {f"1>{other}": {"loss": 1.0} for other in (2, 3, 4)}}
    assert states_of(network(tmp_path, {"at_s": 3.0, "what": "schedule", "asked": asked}))[-1][2] == "2 3 4 | 1"


def test_partition_lasts_while_vehicles_enter_and_leave_range(tmp_path: Path) -> None:
    both = {**ALL, "partition": [[1]], "links": {"1>4": {"loss": 1.0}}}
    found = network(
        tmp_path,
        out_of_range(5.0, "1-4"),
        {"at_s": 10.0, "what": "partition", "asked": both},
        out_of_range(15.0, "1-4", loss=0.0),
        {"at_s": 20.0, "what": "heal", "asked": ALL},
    )
    assert states_of(found)[1:] == [(10.0, "partition", "2 3 4 | 1"), (20.0, "heal", "1 2 3 4")]


def test_scripted_cut_lasts_when_the_pair_enters_range(tmp_path: Path) -> None:
    deaf = {**ALL, "links": {f"1>{other}": {"loss": 1.0} for other in (2, 3, 4)}}
    found = network(
        tmp_path,
        out_of_range(5.0, "1-2", "1-3", "1-4"),
        {"at_s": 10.0, "what": "loss", "asked": deaf},
        out_of_range(15.0, "1-2", "1-3", "1-4", loss=0.0),
    )
    assert [state[2] for state in states_of(found)] == ["1 2 3 4", "2 3 4 | 1"]


def test_final_reconcile_ignores_radio_range(tmp_path: Path) -> None:
    heard_again = {"1-2": 0.0, "1-3": 0.0, "1-4": 0.0}
    found = network(
        tmp_path,
        out_of_range(5.0, "1-2", "1-3", "1-4"),
        {"at_s": 30.0, "what": "final reconcile", "asked": ALL, "losses": heard_again},
    )
    assert states_of(found)[1:] == [(5.0, "range", "2 3 4 | 1"), (30.0, "final reconcile", "1 2 3 4")]


def test_lost_vehicle_has_no_links_until_its_replacement(tmp_path: Path) -> None:
    found = network(
        tmp_path,
        out_of_range(5.0, "1-3", "1-4", "2-4"),
        {"at_s": 10.0, "what": "crash", "agents": [2]},
        {"at_s": 20.0, "what": "restart", "agents": [2]},
        {"at_s": 30.0, "what": "reboot", "agents": [3]},
        {"at_s": 40.0, "what": "kill", "agents": [2, 1]},
    )
    assert states_of(found)[1:] == [
        (10.0, "crash", "3 4 | 1"),
        (20.0, "restart", "1 2 3 4"),
        (40.0, "kill", "3 4"),
    ]
    assert found.airborne_intervals(2, 50.0) == [(0.0, 10.0, True), (20.0, 40.0, True)]
    assert found.airborne_intervals(2, 30.0) == [(0.0, 10.0, True), (20.0, 30.0, False)]
    assert found.airborne_intervals(4, 50.0) == [(0.0, 50.0, False)]
    assert found.reboots == [(30.0, 3)]


def test_flight_changes_agree_with_the_recorded_details(tmp_path: Path) -> None:
    """Compare with the details in run.json, while five vehicles fly apart and back during a partition."""
    scenario = Scenario.model_validate(
        {
            "name": "pulse",
            "agents": 5,
            "duration_s": 300,
            "network": {"radio": {"hard_range": {"range_m": 100}}},
            "timeline": [{"at_s": 111, "partition": [[1, 2]]}, {"at_s": 222, "heal": True}],
        }
    )
    places = {1: (0, 0), 2: (30, 0), 3: (0, 40), 4: (90, 90)}
    ways = {vehicle: still(*place) for vehicle, place in places.items()}
    ways[5] = lambda at_s: (abs(at_s * 7 % 600 - 300), at_s * 3 % 200)
    write_flight(tmp_path, scenario, ways, 300)
    found = read_connectivity(tmp_path / NETWORK_FILE, ways)
    lines = [json.loads(line) for line in (tmp_path / NETWORK_FILE).read_text().splitlines()]
    details = {line["at_s"]: line["detail"] for line in lines if line["what"] == "range"}
    assert len(set(details.values())) > 4
    for at_s, detail in details.items():
        state = [state for state in found.states if state.at_s <= at_s][-1]
        assert groups_text(state.components) == detail


@pytest.mark.parametrize(
    "damaged",
    [
        "{",
        '{"at_s": NaN, "what": "range"}',
        '{"at_s": 1}',
        '{"at_s": 1, "what": "range", "losses": {"1-9": 1.0}}',
        '{"at_s": 1, "what": "range", "losses": {"1-2": "all"}}',
        '{"at_s": 1, "what": "loss", "asked": {"default": {"loss": 7}}}',
        '{"at_s": 1, "what": "loss", "asked": {"links": 3}}',
        '{"at_s": 1, "what": "loss", "asked": {"receivers": {"x": {}}}}',
        '{"at_s": 1, "what": "loss", "asked": {"partition": 7}}',
        '{"at_s": 1, "what": "loss", "asked": {"partition": [7]}}',
        '{"at_s": 1, "what": "loss", "asked": {"<b>": 1}}',
        '{"at_s": 1, "what": "kill", "agents": "all"}',
        json.dumps({"at_s": 1, "what": "x" * 1000}),
    ],
)
def test_damaged_line_is_left_out_and_reported(tmp_path: Path, damaged: str) -> None:
    start = json.dumps({"at_s": 0, "what": "start", "asked": ALL})
    (tmp_path / NETWORK_FILE).write_text("\n".join([start, damaged, json.dumps(partition(2.0, [1]))]))
    found = read_connectivity(tmp_path / NETWORK_FILE, [1, 2])
    assert states_of(found) == [(0.0, "start", "1 2"), (2.0, "partition", "1 | 2")]
    assert found.problems == ["network.jsonl: 1 damaged or unknown line is left out"]


def test_record_without_initial_conditions_has_no_states(tmp_path: Path) -> None:
    write_lines(tmp_path / NETWORK_FILE, [out_of_range(5.0, "1-2")])
    assert read_connectivity(tmp_path / NETWORK_FILE, [1, 2]).states == []


GOOD = {"at_s": 1.0, "places": {"1": [10.0, 20.0, 5.0], "2": [-1, 0, 0]}}


def tracks_file(directory: Path, *lines: str | dict[str, Any]) -> Path:
    path = directory / TRACKS_FILE
    path.write_text("".join((line if isinstance(line, str) else json.dumps(line)) + "\n" for line in lines))
    return path


def test_fixes_are_sorted_by_time(tmp_path: Path) -> None:
    later = {"at_s": 2.0, "places": {"1": [12.0, 24.0, 5.0]}}
    tracks = read_tracks(tracks_file(tmp_path, later, GOOD), [1, 2, 3])
    assert tracks.by_vehicle == {
        1: [PositionFix(1.0, 10.0, 20.0, 5.0), PositionFix(2.0, 12.0, 24.0, 5.0)],
        2: [PositionFix(1.0, -1.0, 0.0)],
    }
    assert tracks.problems == []


def test_position_is_interpolated_between_fixes_only(tmp_path: Path) -> None:
    later = {"at_s": 3.0, "places": {"1": [20.0, 0.0, 5.0]}}
    tracks = read_tracks(tracks_file(tmp_path, GOOD, later), [1, 2])
    assert tracks.at(1, 1.5) == PositionFix(1.5, 12.5, 15.0, 5.0)
    assert tracks.at(1, 0.0) == PositionFix(0.0, 10.0, 20.0, 5.0)
    assert tracks.at(1, 3.0) == PositionFix(3.0, 20.0, 0.0, 5.0)
    assert tracks.at(1, 9.0) == PositionFix(9.0, 20.0, 0.0, 5.0)


def test_missing_file_has_no_tracks(tmp_path: Path) -> None:
    assert read_tracks(tmp_path / TRACKS_FILE, [1]).by_vehicle == {}
    assert read_tracks(tmp_path / TRACKS_FILE, [1]).problems == []


@pytest.mark.parametrize(
    "damaged",
    [
        "",
        "{",
        "[]",
        "null",
        "[" * 100_000,
        '{"at_s": 1.0, "places": {"1": [0, 0, ',
        '{"places": {"1": [0, 0, 0]}}',
        '{"at_s": 1.0}',
        '{"at_s": NaN, "places": {}}',
        '{"at_s": -1, "places": {}}',
        '{"at_s": 1e400, "places": {}}',
        '{"at_s": "1", "places": {}}',
        '{"at_s": 1, "places": {"1": [NaN, 0, 0]}}',
        '{"at_s": 1, "places": {"1": [0, -Infinity, 0]}}',
        '{"at_s": 1, "places": {"1": [1e300, 0, 0]}}',
        '{"at_s": 1, "places": {"1": [' + "9" * 5000 + ", 0, 0]}}",
        '{"at_s": 1, "places": {"1": [0, 0]}}',
        '{"at_s": 1, "places": {"1": {"north_m": 0}}}',
        '{"at_s": 1, "places": {"7": [0, 0, 0]}}',
        '{"at_s": 1, "places": {"1": [0, 0, 0], "<b>": [0, 0, 0]}}',
        '{"at_s": 1, "places": [[0, 0, 0]]}',
        "\x00\x00",
        "\ud83d",
    ],
)
def test_damaged_line_of_tracks_is_left_out_and_reported(tmp_path: Path, damaged: str) -> None:
    path = tmp_path / TRACKS_FILE
    text = "\n".join([json.dumps(GOOD), damaged, json.dumps(GOOD | {"at_s": 2.0})])
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    tracks = read_tracks(path, [1, 2])
    assert [fix.at_s for fix in tracks.by_vehicle[1]] == [1.0, 2.0]
    assert tracks.problems == ["tracks.jsonl: 1 damaged or unknown line is left out"]


def test_reader_stops_at_its_limits_and_reports_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_file, "MAX_LINES_BYTES", 3 * 1024 * 1024)
    monkeypatch.setattr(bounded_file, "MAX_LINE_BYTES", 1024 * 1024)
    tracks = read_tracks(tracks_file(tmp_path, GOOD, "x" * 1024 * 1024, GOOD), [1, 2])
    assert len(tracks.by_vehicle[1]) == 1
    assert tracks.problems == ["tracks.jsonl: the part after 1 MiB without a line end is left out"]
    tracks = read_tracks(tracks_file(tmp_path, *["x" * 1000 * 1000] * 3, GOOD, "x" * 1000 * 1000, GOOD), [1, 2])
    assert len(tracks.by_vehicle[1]) == 1
    assert tracks.problems == [
        "tracks.jsonl: 3 damaged or unknown lines are left out",
        "tracks.jsonl: only the first 50000 lines or 3 MiB are read",
    ]
    monkeypatch.setattr(bounded_file, "MAX_LINES", 2)
    assert len(read_tracks(tracks_file(tmp_path, GOOD, GOOD), [1, 2]).by_vehicle[1]) == 2
    tracks = read_tracks(tracks_file(tmp_path, GOOD, GOOD, GOOD), [1, 2])
    assert len(tracks.by_vehicle[1]) == 2
    assert tracks.problems == ["tracks.jsonl: only the first 2 lines or 3 MiB are read"]


def test_directory_in_place_of_the_file_has_no_tracks(tmp_path: Path) -> None:
    (tmp_path / TRACKS_FILE).mkdir()
    assert read_tracks(tmp_path / TRACKS_FILE, [1]).by_vehicle == {}
