"""What came home is sorted by what is in it, everything usable is used, and everything else is named."""

import gzip
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from harness.archive.traces import MAX_LINE_BYTES, Gap, read_trace
from harness.errors import FieldError
from harness.field.ingest import Homecoming, sort_out
from tests.harness.field.flights import flown, trace_of


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("whole") / "run", capture=True, duration_s=1200)


@pytest.fixture(scope="module")
def another(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("another") / "run", seed=2, duration_s=200)


@pytest.fixture
def home(whole: Path, tmp_path: Path) -> Path:
    """A copy, to be damaged."""
    shutil.copytree(whole, tmp_path / "home")
    return tmp_path / "home"


def why(homecoming: Homecoming) -> str:
    return "\n".join(homecoming.sentences())


def lines_of(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True)


def test_a_run_is_one_flight_and_nothing_is_left_out(whole: Path) -> None:
    homecoming = sort_out([whole])
    assert not homecoming.left_out and not homecoming.remarks
    (flight,) = homecoming.flights
    assert list(flight.traces) == list(flight.exports) == list(flight.captures) == [1, 2, 3]
    assert flight.initial_data == b"test, seed 1" and flight.roster == (1, 2, 3) and flight.epoch_us == 0
    for agent, trace in flight.traces.items():
        of_archive = read_trace(trace_of(whole, agent))
        assert of_archive and trace.runs == of_archive.runs and trace.asides == of_archive.asides
        assert list(trace.incarnations().__next__()) == list(of_archive.incarnations().__next__())
        assert not trace.gaps


def test_names_and_packing_do_not_matter(home: Path) -> None:
    names = iter(range(100))
    for directory in ("agents", "capture"):
        for path in sorted((home / directory).iterdir()):
            (home.parent / f"{next(names)}.dat").write_bytes(gzip.compress(path.read_bytes()))
    shutil.rmtree(home)
    homecoming = sort_out([home.parent])
    assert not homecoming.left_out, why(homecoming)
    assert list(homecoming.largest().traces) == list(homecoming.largest().captures) == [1, 2, 3]


def test_what_follows_a_damaged_line_is_used_and_the_gap_is_known(home: Path) -> None:
    path = trace_of(home, 2)
    lines = lines_of(path)
    lines[5:7] = [b"\x13\x37" + lines[5][50:], lines[6][:40] + b"\n"]
    path.write_bytes(b"".join(lines))
    homecoming = sort_out([home])
    trace = homecoming.largest().traces[2]
    assert len(trace.runs) == len(lines) - 3
    assert trace.gaps == [Gap(4, 2, len(lines[5]) + len(lines[6]))]
    assert [line for line, _ in next(trace.incarnations())] == [2, 3, 4, 5, *range(8, len(lines) + 1)]
    (left_out,) = homecoming.left_out
    assert left_out.sentence == f"{path}, line 6: it is damaged, and so is the rest up to line 7"


def test_half_a_line_with_another_after_it_costs_only_the_half(home: Path) -> None:
    path = trace_of(home, 2)
    lines = lines_of(path)
    lines[5] = lines[5][:60]  # the next is glued to it
    path.write_bytes(b"".join(lines))
    homecoming = sort_out([home])
    trace = homecoming.largest().traces[2]
    assert len(trace.runs) == len(lines) - 2 and trace.gaps == [Gap(4, 1, 60)]
    assert "line 6: it is damaged; its readable end is used" in why(homecoming)


def test_a_loss_of_power_leaves_nul_at_the_end_or_before_the_next_life(home: Path, whole: Path) -> None:
    path = trace_of(home, 3)
    content, lines = path.read_bytes(), lines_of(path)
    path.write_bytes(content + b"\0" * 5000)
    trace = sort_out([home]).largest().traces[3]
    assert len(trace.runs) == len(lines) - 1 and trace.cut_off
    path.write_bytes(
        b"".join(lines[:10]) + lines[10][:30] + b"\0" * 2 * MAX_LINE_BYTES + b"".join([lines[0], *lines[1:20]])
    )
    homecoming = sort_out([trace_of(home, 3)])
    assert "NUL" in why(homecoming)
    assert len(homecoming.largest().traces[3].runs) == 19, "the life that was begun anew has the first in it"


def test_a_damaged_header_is_lent_by_another_agent_of_the_flight(home: Path) -> None:
    path = trace_of(home, 1)
    lines = lines_of(path)
    path.write_bytes(b"".join([lines[0][:70] + b"\x01" + lines[0][71:], *lines[1:]]))
    homecoming = sort_out([home])
    trace = homecoming.largest().traces[1]
    assert trace.header.agent_id == 1 and len(trace.runs) == len(lines) - 1 and not trace.gaps
    assert "its header is lost; it is read as a trace of agent 1, with the header of the trace of agent 2" in why(
        homecoming
    )


def test_a_trace_without_its_beginning_begins_with_a_gap(home: Path) -> None:
    path = trace_of(home, 1)
    path.write_bytes(b"".join(lines_of(path)[100:]))
    trace = sort_out([home]).largest().traces[1]
    assert trace.gaps == [Gap(0, 0, 0)]


@pytest.mark.parametrize("in_one_file", [True, False])
def test_two_flights_are_told_apart(home: Path, another: Path, in_one_file: bool) -> None:
    if in_one_file:
        trace_of(home, 1).write_bytes(trace_of(home, 1).read_bytes() + trace_of(another, 1).read_bytes())
    else:
        shutil.copytree(another / "agents", home / "agents" / "yesterday")
    homecoming = sort_out([home])
    assert [flight.initial_data for flight in homecoming.flights] == [b"test, seed 1", b"test, seed 2"]
    first, second = (read_trace(trace_of(directory, 1)) for directory in (home, another))
    assert first and second
    assert homecoming.flights[0].traces[1].runs == first.runs
    assert homecoming.flights[1].traces[1].runs == second.runs
    assert "belong to another flight than the largest one" in why(homecoming)


def test_the_same_mission_flown_twice_is_two_flights(home: Path) -> None:
    again = home / "agents" / "again"
    again.mkdir()
    for agent in (1, 2, 3):
        text = trace_of(home, agent).read_text().replace('"epoch_us":0', '"epoch_us":86400000000')
        (again / f"{agent}.jsonl").write_text(text)
    homecoming = sort_out([home])
    assert [flight.epoch_us for flight in homecoming.flights] == [0, 86400000000]
    assert list(homecoming.flights[1].traces) == [1, 2, 3]


def test_the_same_file_twice_is_used_once(home: Path) -> None:
    path = trace_of(home, 1)
    lines = lines_of(path)
    shutil.copy(path, home / "copy.txt")
    (home / "half").write_bytes(b"".join(lines[:50]))
    (home / "damaged").write_bytes(b"".join([*lines[:20], b"?\n", *lines[21:60]]))
    homecoming = sort_out([home])
    trace = homecoming.largest().traces[1]
    assert len(homecoming.flights) == 1 and len(trace.runs) == len(lines) - 1 and not trace.starts
    told = why(homecoming)
    assert "its content equals" in told and told.count("on; the lines there are used") == 2


def test_what_is_lost_of_one_copy_is_taken_from_another(home: Path) -> None:
    path = trace_of(home, 1)
    lines = lines_of(path)
    whole = sort_out([path]).largest().traces[1]
    path.write_bytes(b"".join([*lines[:20], b"?\n", *lines[23:50], b"?\n", *lines[51:-9]]))
    (home / "copy").write_bytes(b"".join([*lines[:48], b"?\n", *lines[54:70], lines[71][:5]]))
    (home / "end").write_bytes(b"".join([lines[0], *lines[60:]]))
    homecoming = sort_out([path, home / "copy", home / "end"])
    trace = homecoming.largest().traces[1]
    assert trace.runs == [*whole.runs[:49], *whole.runs[50:]] and trace.gaps == [Gap(49, 1, 2)] and not trace.cut_off
    assert "3 handler runs that are lost there are read from here" in why(homecoming)
    assert "9 handler runs that are lost there are read from here" in why(homecoming)


def test_a_trace_that_was_begun_in_another_file_goes_on_in_this_one(home: Path) -> None:
    path = trace_of(home, 1)
    lines = lines_of(path)
    path.write_bytes(b"".join(lines[:80]))
    path.with_name("1.trace.jsonl.1").write_bytes(b"".join([lines[0], *lines[80:]]))
    trace = sort_out([home]).largest().traces[1]
    assert len(trace.runs) == len(lines) - 1 and trace.starts == [79]


def test_a_clock_that_jumps_is_told(home: Path) -> None:
    path = trace_of(home, 1)
    runs = [json.loads(line) for line in lines_of(path)]
    for run in runs[30:]:
        run["t"] -= 20
    path.write_text("".join(json.dumps(run) + "\n" for run in runs))
    homecoming = sort_out([home])
    assert homecoming.largest().traces[1].jumps == [29]
    assert "line 31: the clock of agent 1 jumps from" in why(homecoming) and not homecoming.left_out


def test_a_time_that_cannot_be_is_no_damage(home: Path) -> None:
    path = trace_of(home, 1)
    lines = lines_of(path)
    lines[4] = json.dumps(json.loads(lines[4]) | {"t": 1.79e9}).encode() + b"\n"
    path.write_bytes(b"".join(lines))
    homecoming = sort_out([home])
    assert "line 5: its time cannot be" in why(homecoming) and len(homecoming.largest().traces[1].gaps) == 1


def test_what_could_be_used_if_it_were_otherwise_is_told_the_way_out(home: Path) -> None:
    (home / "utf16.jsonl").write_text(trace_of(home, 1).read_text(), encoding="utf-16")
    (home / "home.zip").write_bytes(b"PK\x03\x04" + bytes(100))
    (home / "flight.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    told = why(sort_out([home]))
    assert "iconv" in told and "unpack it first" in told and "read it with `ucp-harness import`" in told


def test_windows_line_ends_and_a_byte_order_mark_are_nothing(home: Path) -> None:
    for path in (home / "agents").iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    homecoming = sort_out([home])
    assert not homecoming.left_out and not homecoming.largest().traces[1].gaps
    assert list(homecoming.largest().exports) == [1, 2, 3]


def test_other_peoples_files_are_named(home: Path) -> None:
    (home / "empty").write_bytes(b"")
    (home / "notes.txt").write_text("14:02 vehicle 3 would not arm")
    (home / "photo.jpg").write_bytes(bytes(range(256)) * 40)
    (home / "mission.json").write_text('{"schema": "ucp-mission/1"}')
    (home / "list.json").write_text("[1, 2]")
    os.mkfifo(home / "fifo")
    (home / "circle").symlink_to(home)
    homecoming = sort_out([home])
    assert list(homecoming.largest().traces) == [1, 2, 3]
    named = {left_out.path.name for left_out in homecoming.left_out}
    assert named == {"empty", "notes.txt", "photo.jpg", "mission.json", "list.json", "fifo", "circle"}


def test_many_alike_are_summed_up(home: Path) -> None:
    for number in range(200):
        (home / f"{number}.txt").write_text(f"{number}")
    homecoming = sort_out([home])
    assert len(homecoming.left_out) == 4
    assert "197 more files (3.txt, " in why(homecoming)


def test_an_agent_that_is_not_of_the_mission_is_named(home: Path, tmp_path: Path) -> None:
    (tmp_path / "9.chain.json").write_text(
        (home / "agents" / "1.chain.json").read_text().replace('"agent_id": 1', '"agent_id": 9', 1)
    )
    (tmp_path / "9.trace.jsonl").write_text(trace_of(home, 1).read_text().replace('"agent_id":1', '"agent_id":9', 1))
    told = why(sort_out([home, tmp_path / "9.chain.json", tmp_path / "9.trace.jsonl"]))
    assert "9.chain.json: agent 9 is not on the roster of its mission" in told
    assert "9.trace.jsonl, line 1: agent 9 is not on the roster in its own trace" in told


def test_an_earlier_export_gives_way_to_a_later(home: Path) -> None:
    path = home / "agents" / "1.chain.json"
    document: dict[str, Any] = json.loads(path.read_text())
    document["chain"].pop()
    document["exported_at_us"] -= 1
    (home / "before.json").write_text(json.dumps(document))
    homecoming = sort_out([home])
    assert len(homecoming.largest().exports[1].chain) == len(document["chain"]) + 1
    assert "before.json: agent 1 exported its chain again, later" in why(homecoming)


def test_a_bomb_is_read_up_to_a_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.field.ingest._trace_incarnations.NOTHING_WITHIN_BYTES", 1 << 20)
    monkeypatch.setattr("harness.field.ingest._sorting.MAX_EXPORT_BYTES", 1 << 20)
    (tmp_path / "bomb").write_bytes(gzip.compress(bytes(50 << 20)))
    homecoming = sort_out([tmp_path])
    assert not homecoming.flights
    assert why(homecoming) == f"{tmp_path / 'bomb'}: it is incomplete: only the first 1 MiB are read"


def test_packed_files_that_break_off_are_used_as_far_as_they_go(home: Path) -> None:
    path = trace_of(home, 1)
    packed = gzip.compress(path.read_bytes())
    path.write_bytes(packed[: len(packed) // 2])
    homecoming = sort_out([home])
    assert len(homecoming.largest().traces[1].runs) > 10
    assert "the gzip data ends early" in why(homecoming)


def test_nothing_usable_is_an_error_that_says_why(tmp_path: Path) -> None:
    (tmp_path / "1.trace.jsonl").write_text("hello")
    with pytest.raises(FieldError, match=r"none of these files is a usable .* text without UCP records"):
        sort_out([tmp_path]).largest()
    with pytest.raises(FieldError, match="does not exist"):
        sort_out([tmp_path / "nowhere"])
