"""Test the function that reads the files of a flight. It groups records by their content, and uses every usable
part.
"""

import base64
import gzip
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from harness.archive.traces import MAX_LINE_BYTES, TraceGap, read_trace
from harness.errors import FieldError
from harness.field.adapters import import_records
from harness.field.ingest import IngestResult, ingest_files
from tests.harness.field.flights import flown, trace_of


@pytest.fixture(scope="module")
def intact_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("whole") / "run", capture=True, duration_s=1200)


@pytest.fixture(scope="module")
def other_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("another") / "run", seed=2, duration_s=200)


@pytest.fixture
def damaged_copy(intact_run: Path, tmp_path: Path) -> Path:
    """Return a copy of the run, which a test may damage."""
    shutil.copytree(intact_run, tmp_path / "home")
    return tmp_path / "home"


def report_of(result: IngestResult) -> str:
    return "\n".join(result.sentences())


def lines_of(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True)


def test_intact_run_is_one_flight_without_omissions(intact_run: Path) -> None:
    result = ingest_files([intact_run])
    assert not result.left_out and not result.remarks
    (flight,) = result.flights
    assert list(flight.traces) == list(flight.exports) == list(flight.captures) == [1, 2, 3]
    assert flight.initial_data == b"test, seed 1" and flight.roster == (1, 2, 3) and flight.epoch_us == 0
    for agent, trace in flight.traces.items():
        of_archive = read_trace(trace_of(intact_run, agent))
        assert of_archive and trace.runs == of_archive.runs and trace.asides == of_archive.asides
        assert list(trace.incarnations().__next__()) == list(of_archive.incarnations().__next__())
        assert not trace.gaps


def test_file_names_and_compression_do_not_matter(damaged_copy: Path) -> None:
    names = iter(range(100))
    for directory in ("agents", "capture"):
        for path in sorted((damaged_copy / directory).iterdir()):
            (damaged_copy.parent / f"{next(names)}.dat").write_bytes(gzip.compress(path.read_bytes()))
    shutil.rmtree(damaged_copy)
    result = ingest_files([damaged_copy.parent])
    assert not result.left_out, report_of(result)
    assert list(result.largest().traces) == list(result.largest().captures) == [1, 2, 3]


def test_lines_after_damage_are_used_and_the_gap_is_noted(damaged_copy: Path) -> None:
    path = trace_of(damaged_copy, 2)
    lines = lines_of(path)
    lines[5:7] = [b"\x13\x37" + lines[5][50:], lines[6][:40] + b"\n"]
    path.write_bytes(b"".join(lines))
    result = ingest_files([damaged_copy])
    trace = result.largest().traces[2]
    assert len(trace.runs) == len(lines) - 3
    assert trace.gaps == [TraceGap(4, 2, len(lines[5]) + len(lines[6]))]
    assert [line for line, _ in next(trace.incarnations())] == [2, 3, 4, 5, *range(8, len(lines) + 1)]
    (left_out,) = result.left_out
    assert left_out.sentence == f"{path}, line 6: it is damaged, and so is the rest up to line 7"


def test_complete_line_after_a_truncated_one_is_recovered(damaged_copy: Path) -> None:
    path = trace_of(damaged_copy, 2)
    lines = lines_of(path)
    lines[5] = lines[5][:60]  # The next line is appended to it.
    path.write_bytes(b"".join(lines))
    result = ingest_files([damaged_copy])
    trace = result.largest().traces[2]
    assert len(trace.runs) == len(lines) - 2 and trace.gaps == [TraceGap(4, 1, 60)]
    assert "line 6: it is damaged; its readable end is used" in report_of(result)


def test_nul_bytes_after_a_power_loss_are_skipped(damaged_copy: Path, intact_run: Path) -> None:
    path = trace_of(damaged_copy, 3)
    content, lines = path.read_bytes(), lines_of(path)
    path.write_bytes(content + b"\0" * 5000)
    trace = ingest_files([damaged_copy]).largest().traces[3]
    assert len(trace.runs) == len(lines) - 1 and trace.cut_off
    path.write_bytes(
        b"".join(lines[:10]) + lines[10][:30] + b"\0" * 2 * MAX_LINE_BYTES + b"".join([lines[0], *lines[1:20]])
    )
    result = ingest_files([trace_of(damaged_copy, 3)])
    assert "NUL" in report_of(result)
    assert len(result.largest().traces[3].runs) == 19, "the life that was begun anew has the first in it"


def test_damaged_header_is_replaced_by_that_of_another_agent(damaged_copy: Path) -> None:
    path = trace_of(damaged_copy, 1)
    lines = lines_of(path)
    path.write_bytes(b"".join([lines[0][:70] + b"\x01" + lines[0][71:], *lines[1:]]))
    result = ingest_files([damaged_copy])
    trace = result.largest().traces[1]
    assert trace.header.agent_id == 1 and len(trace.runs) == len(lines) - 1 and not trace.gaps
    assert "its header is lost; it is read as a trace of agent 1, with the header of the trace of agent 2" in report_of(
        result
    )


def test_trace_without_its_beginning_begins_with_a_gap(damaged_copy: Path) -> None:
    path = trace_of(damaged_copy, 1)
    path.write_bytes(b"".join(lines_of(path)[100:]))
    trace = ingest_files([damaged_copy]).largest().traces[1]
    assert trace.gaps == [TraceGap(0, 0, 0)]


@pytest.mark.parametrize("in_one_file", [True, False])
def test_records_of_two_flights_are_separated(damaged_copy: Path, other_run: Path, in_one_file: bool) -> None:
    if in_one_file:
        trace_of(damaged_copy, 1).write_bytes(
            trace_of(damaged_copy, 1).read_bytes() + trace_of(other_run, 1).read_bytes()
        )
    else:
        shutil.copytree(other_run / "agents", damaged_copy / "agents" / "yesterday")
    result = ingest_files([damaged_copy])
    assert [flight.initial_data for flight in result.flights] == [b"test, seed 1", b"test, seed 2"]
    first, second = (read_trace(trace_of(directory, 1)) for directory in (damaged_copy, other_run))
    assert first and second
    assert result.flights[0].traces[1].runs == first.runs
    assert result.flights[1].traces[1].runs == second.runs
    assert "belong to another flight than the largest one" in report_of(result)


def test_mixed_lines_of_two_agents_are_left_out(damaged_copy: Path) -> None:
    one, other = trace_of(damaged_copy, 1), trace_of(damaged_copy, 2)
    lines, others = lines_of(one), lines_of(other)
    middle = len(lines) // 2
    pairs = [line for pair in zip(lines[middle:], others[1:], strict=False) for line in pair]
    one.write_bytes(b"".join([*lines[:middle], others[0], *pairs]))
    other.unlink()
    result = ingest_files([damaged_copy])
    (flight,) = result.flights
    assert len(flight.traces[1].runs) == middle - 1
    assert flight.traces[1].gaps[-1].position == middle - 1
    assert 2 not in flight.traces
    assert f"line {middle + 1}: from here on, the lines of agents 1, 2 are mixed, and none" in report_of(result)


def test_mission_file_gives_the_roster_of_exports(intact_run: Path, tmp_path: Path) -> None:
    for path in intact_run.glob("agents/*.chain.json"):
        shutil.copy(path, tmp_path)
    network = {"address": "10.77.0.4", "broadcast": "10.79.255.255", "port": 14600}
    mission = {"agent_id": 4, "roster": [1, 2, 3, 4], "initial_data": base64.b64encode(b"test, seed 1").decode()}
    document = {"schema": "ucp-mission/1", **mission, "network": network, "events": {"source": "none"}, "seed": 1}
    (tmp_path / "4.mission.json").write_text(json.dumps({**document, "speedup": 1}))
    other = {**document, "initial_data": base64.b64encode(b"another").decode(), "speedup": 1}
    (tmp_path / "other.mission.json").write_text(json.dumps(other))
    result = ingest_files([tmp_path])
    (flight,) = result.flights
    assert flight.roster == (1, 2, 3, 4)
    assert flight.mission_files == {4: tmp_path / "4.mission.json"}
    assert "other.mission.json: a mission file of another mission" in report_of(result)
    assert "4.mission.json" not in report_of(result)
    import_records([tmp_path], [], tmp_path / "home")
    assert json.loads((tmp_path / "home/agents/4.mission.json").read_text()) == {**document, "speedup": 1}


def test_mission_flown_twice_gives_two_flights(damaged_copy: Path) -> None:
    again = damaged_copy / "agents" / "again"
    again.mkdir()
    for agent in (1, 2, 3):
        text = trace_of(damaged_copy, agent).read_text().replace('"epoch_us":0', '"epoch_us":86400000000')
        (again / f"{agent}.jsonl").write_text(text)
    result = ingest_files([damaged_copy])
    assert [flight.epoch_us for flight in result.flights] == [0, 86400000000]
    assert list(result.flights[1].traces) == [1, 2, 3]


def test_duplicate_file_is_used_once(damaged_copy: Path) -> None:
    path = trace_of(damaged_copy, 1)
    lines = lines_of(path)
    shutil.copy(path, damaged_copy / "copy.txt")
    (damaged_copy / "half").write_bytes(b"".join(lines[:50]))
    (damaged_copy / "damaged").write_bytes(b"".join([*lines[:20], b"?\n", *lines[21:60]]))
    result = ingest_files([damaged_copy])
    trace = result.largest().traces[1]
    assert len(result.flights) == 1 and len(trace.runs) == len(lines) - 1 and not trace.starts
    report = report_of(result)
    assert "its content equals" in report and report.count("on; the lines there are used") == 2


def test_gap_in_one_copy_is_filled_from_another(damaged_copy: Path) -> None:
    path = trace_of(damaged_copy, 1)
    lines = lines_of(path)
    intact_run = ingest_files([path]).largest().traces[1]
    path.write_bytes(b"".join([*lines[:20], b"?\n", *lines[23:50], b"?\n", *lines[51:-9]]))
    (damaged_copy / "copy").write_bytes(b"".join([*lines[:48], b"?\n", *lines[54:70], lines[71][:5]]))
    (damaged_copy / "end").write_bytes(b"".join([lines[0], *lines[60:]]))
    result = ingest_files([path, damaged_copy / "copy", damaged_copy / "end"])
    trace = result.largest().traces[1]
    assert (
        trace.runs == [*intact_run.runs[:49], *intact_run.runs[50:]]
        and trace.gaps == [TraceGap(49, 1, 2)]
        and not trace.cut_off
    )
    assert "3 handler runs that are lost there are read from here" in report_of(result)
    assert "9 handler runs that are lost there are read from here" in report_of(result)


def test_trace_may_continue_in_another_file(damaged_copy: Path) -> None:
    path = trace_of(damaged_copy, 1)
    lines = lines_of(path)
    path.write_bytes(b"".join(lines[:80]))
    path.with_name("1.trace.jsonl.1").write_bytes(b"".join([lines[0], *lines[80:]]))
    trace = ingest_files([damaged_copy]).largest().traces[1]
    assert len(trace.runs) == len(lines) - 1 and trace.starts == [79]


def test_clock_jump_is_reported(damaged_copy: Path) -> None:
    path = trace_of(damaged_copy, 1)
    runs = [json.loads(line) for line in lines_of(path)]
    for run in runs[30:]:
        run["t"] -= 20
    path.write_text("".join(json.dumps(run) + "\n" for run in runs))
    result = ingest_files([damaged_copy])
    assert result.largest().traces[1].jumps == [29]
    assert "line 31: the clock of agent 1 jumps from" in report_of(result) and not result.left_out


def test_impossible_time_is_reported_as_a_gap(damaged_copy: Path) -> None:
    path = trace_of(damaged_copy, 1)
    lines = lines_of(path)
    lines[4] = json.dumps(json.loads(lines[4]) | {"t": 1.79e9}).encode() + b"\n"
    path.write_bytes(b"".join(lines))
    result = ingest_files([damaged_copy])
    assert "line 5: its time cannot be" in report_of(result) and len(result.largest().traces[1].gaps) == 1


def test_omission_of_a_convertible_file_names_the_conversion(damaged_copy: Path) -> None:
    (damaged_copy / "utf16.jsonl").write_text(trace_of(damaged_copy, 1).read_text(), encoding="utf-16")
    (damaged_copy / "home.zip").write_bytes(b"PK\x03\x04" + bytes(100))
    (damaged_copy / "flight.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    report = report_of(ingest_files([damaged_copy]))
    assert "iconv" in report and "unpack it first" in report and "read it with `ucp-harness import`" in report


def test_windows_line_ends_and_byte_order_mark_are_accepted(damaged_copy: Path) -> None:
    for path in (damaged_copy / "agents").iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    result = ingest_files([damaged_copy])
    assert not result.left_out and not result.largest().traces[1].gaps
    assert list(result.largest().exports) == [1, 2, 3]


def test_unrelated_files_are_reported(damaged_copy: Path) -> None:
    (damaged_copy / "empty").write_bytes(b"")
    (damaged_copy / "notes.txt").write_text("14:02 vehicle 3 would not arm")
    (damaged_copy / "photo.jpg").write_bytes(bytes(range(256)) * 40)
    (damaged_copy / "mission.json").write_text('{"schema": "ucp-mission/1"}')
    (damaged_copy / "list.json").write_text("[1, 2]")
    os.mkfifo(damaged_copy / "fifo")
    (damaged_copy / "circle").symlink_to(damaged_copy)
    result = ingest_files([damaged_copy])
    assert list(result.largest().traces) == [1, 2, 3]
    named = {left_out.path.name for left_out in result.left_out}
    assert named == {"empty", "notes.txt", "photo.jpg", "mission.json", "list.json", "fifo", "circle"}


def test_many_equal_omissions_are_combined(damaged_copy: Path) -> None:
    for number in range(200):
        (damaged_copy / f"{number}.txt").write_text(f"{number}")
    result = ingest_files([damaged_copy])
    assert len(result.left_out) == 4
    assert "197 more files (3.txt, " in report_of(result)


def test_agent_outside_the_mission_is_reported(damaged_copy: Path, tmp_path: Path) -> None:
    (tmp_path / "9.chain.json").write_text(
        (damaged_copy / "agents" / "1.chain.json").read_text().replace('"agent_id": 1', '"agent_id": 9', 1)
    )
    (tmp_path / "9.trace.jsonl").write_text(
        trace_of(damaged_copy, 1).read_text().replace('"agent_id":1', '"agent_id":9', 1)
    )
    report = report_of(ingest_files([damaged_copy, tmp_path / "9.chain.json", tmp_path / "9.trace.jsonl"]))
    assert "9.chain.json: agent 9 is not on the roster of its mission" in report
    assert "9.trace.jsonl, line 1: agent 9 is not on the roster in its own trace" in report


def test_later_export_replaces_the_earlier_one(damaged_copy: Path) -> None:
    path = damaged_copy / "agents" / "1.chain.json"
    document: dict[str, Any] = json.loads(path.read_text())
    document["chain"].pop()
    document["exported_at_us"] -= 1
    (damaged_copy / "before.json").write_text(json.dumps(document))
    result = ingest_files([damaged_copy])
    assert len(result.largest().exports[1].chain) == len(document["chain"]) + 1
    assert "before.json: agent 1 exported its chain again, later" in report_of(result)


def test_gzip_bomb_is_read_up_to_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.field.ingest._trace_incarnations.MAX_BYTES_BEFORE_TRACE", 1 << 20)
    monkeypatch.setattr("harness.field.ingest._sorting.MAX_EXPORT_BYTES", 1 << 20)
    (tmp_path / "bomb").write_bytes(gzip.compress(bytes(50 << 20)))
    result = ingest_files([tmp_path])
    assert not result.flights
    assert report_of(result) == f"{tmp_path / 'bomb'}: it is incomplete: only the first 1 MiB are read"


def test_truncated_gzip_file_is_used_up_to_its_end(damaged_copy: Path) -> None:
    path = trace_of(damaged_copy, 1)
    packed = gzip.compress(path.read_bytes())
    path.write_bytes(packed[: len(packed) // 2])
    result = ingest_files([damaged_copy])
    assert len(result.largest().traces[1].runs) > 10
    assert "the gzip data ends early" in report_of(result)


def test_unusable_files_raise_an_error_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "1.trace.jsonl").write_text("hello")
    with pytest.raises(FieldError, match=r"none of these files is a usable .* text without UCP records"):
        ingest_files([tmp_path]).largest()
    with pytest.raises(FieldError, match="does not exist"):
        ingest_files([tmp_path / "nowhere"])
