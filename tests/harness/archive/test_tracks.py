"""Test the recorded positions of vehicles in complete, damaged and hostile files."""

import json
from pathlib import Path
from typing import Any

import pytest

from harness.archive import bounded_file
from harness.archive.directory import TRACKS_FILE
from harness.archive.tracks import PositionFix, read_tracks

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
def test_damaged_line_is_left_out_and_reported(tmp_path: Path, damaged: str) -> None:
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
