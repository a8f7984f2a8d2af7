"""Test the import of records of other programs: the import invents nothing, and reports each omission."""

import csv
import json
import re
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest

from harness import checker
from harness.archive.archive import RunArchive
from harness.archive.packets.capture_files import capture_files, read_captures
from harness.archive.traces import read_trace
from harness.errors import FieldError, MachineError
from harness.field.adapters import import_records
from harness.field.adapters.adapter import TraceLine
from harness.field.adapters.bags._decompression import RawMessage
from harness.field.adapters.bags._sqlite import items as sqlite_items
from harness.field.adapters.csv_adapter import CsvAdapter
from harness.field.adapters.imported_records import ImportRecord
from harness.field.adapters.rosbag_adapter import RosBag
from harness.field.ingest import ingest_files
from tests.harness.command import harness, sentences
from tests.harness.field.flights import flown, trace_of
from tests.harness.field.recordings import of_run, write_bag1, write_bag2, write_csv

WRITERS: dict[str, Callable[..., Path]] = {
    "csv": write_csv,
    "bag1": write_bag1,
    "bag1 bz2": lambda path, records: write_bag1(path, records, "BZ2"),
    "bag1 lz4": lambda path, records: write_bag1(path, records, "LZ4"),
    "bag2 sqlite3": write_bag2,
    "bag2 mcap": lambda path, records: write_bag2(path, records, "mcap"),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("whole") / "run", capture=True, quirks={"ignore_commit": 0.3})


def imported(out: Path, *sources: Path) -> ImportRecord:
    return import_records(sources, [CsvAdapter(), RosBag()], out)


def remarks_of(record: ImportRecord) -> str:
    return "\n".join(remark.sentence for remark in (*record.left_out, *record.remarks))


def verdicts(directory: Path) -> Any:
    result = checker.check(checker.gather(RunArchive(directory)))
    return {key: (judgement.verdict, judgement.reason) for key, judgement in result.judgements.items()}


@pytest.mark.parametrize("writer", WRITERS)
def test_imported_records_equal_the_originals(run: Path, tmp_path: Path, writer: str) -> None:
    source = WRITERS[writer](tmp_path / "recording", of_run(run))
    record = imported(tmp_path / "out", source)
    assert not remarks_of(record)
    bare = tmp_path / "bare"
    shutil.copytree(run / "agents", bare)
    assert verdicts(tmp_path / "out") == verdicts(bare)
    for path in bare.iterdir():
        assert (tmp_path / "out" / "agents" / path.name).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("writer", WRITERS)
def test_recorded_datagrams_give_a_capture_without_a_trace(run: Path, tmp_path: Path, writer: str) -> None:
    source = WRITERS[writer](tmp_path / "recording", of_run(run, ("sent",)))
    record = imported(tmp_path / "out", source)
    assert not remarks_of(record)
    (flight,) = record.flights
    assert [agent.trace for agent in flight.agents.values()] == [None] * 3
    heard, were = (read_captures(capture_files([directory])) for directory in (tmp_path / "out", run))
    assert [capture.vehicle for capture in heard.used] == [1, 2, 3]
    assert len(heard.datagrams) == len(were.datagrams)
    assert not ingest_files([tmp_path / "out"]).left_out


def test_sources_of_several_formats_are_combined(run: Path, tmp_path: Path) -> None:
    records = [*of_run(run)]
    write_csv(tmp_path / "1.csv", iter(said for said in records if said.agent == 1))
    write_bag1(tmp_path / "2.bag", iter(said for said in records if said.agent == 2))
    shutil.copy(trace_of(run, 3), tmp_path / "3.log")
    (tmp_path / "letter.txt").write_text("Dear all,")
    record = imported(tmp_path / "out", *(path for path in tmp_path.iterdir()))
    assert list(record.flights[0].agents) == [1, 2, 3]
    assert re.fullmatch(r".*letter\.txt: it is not a trace.*", remarks_of(record))


@pytest.mark.parametrize("writer", [writer for writer in WRITERS if writer != "csv"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_truncated_bag_is_used_up_to_its_end(run: Path, tmp_path: Path, writer: str, share: float) -> None:
    path = WRITERS[writer](tmp_path / "recording", of_run(run))
    if path.is_dir():
        (path / "metadata.yaml").unlink()
        (path,) = path.iterdir()
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    try:
        record = imported(tmp_path / "out", path)
    except FieldError as error:
        assert "data ends early" in str(error) or "cannot be read" in str(error)
        return
    assert re.search("ends early|cannot be read", remarks_of(record)), remarks_of(record)
    assert sum(agent.handler_runs for agent in record.flights[0].agents.values()) > 5


@pytest.mark.parametrize("writer", ["bag1", "bag2 sqlite3", "bag2 mcap"])
@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_messages_after_damage_in_a_bag_are_used(run: Path, tmp_path: Path, writer: str, share: float) -> None:
    path = WRITERS[writer](tmp_path / "recording", of_run(run))
    if path.is_dir():
        path = next(each for each in path.iterdir() if each.name != "metadata.yaml")
    content = bytearray(path.read_bytes())
    place = int(len(content) * share)
    content[place : place + 3000] = b"\xff" * 3000
    path.write_bytes(content)
    record = imported(tmp_path / "out", path)
    assert remarks_of(record)
    assert sum(agent.handler_runs for agent in record.flights[0].agents.values()) > 230
    traces = ingest_files([tmp_path / "out"]).largest().traces.values()
    assert any(trace.gaps for trace in traces)


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_truncated_sqlite_bag_has_every_message_up_to_its_end(tmp_path: Path, share: float) -> None:
    long = flown(tmp_path / "run", agents=5, duration_s=900)
    (path,) = write_bag2(tmp_path / "bag", of_run(long)).glob("*.db3")
    messages = sum(1 for _ in of_run(long))
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    read = [item for item in sqlite_items(path, tmp_path) if isinstance(item, RawMessage)]
    assert share - 0.03 < len(read) / messages < share + 0.03


def test_missing_quote_in_csv_damages_only_its_row(run: Path, tmp_path: Path) -> None:
    """All cells are quoted, and the JSON text in a cell extends over several lines."""
    path = tmp_path / "records.csv"
    items = [*of_run(run, ("trace",))]
    with path.open("w", newline="") as file:
        writer = csv.writer(file, quoting=csv.QUOTE_ALL)
        writer.writerow(["time_s", "agent", "kind", "event", "data"])
        for item in items:
            writer.writerow(["1790000000", item.agent, item.kind, "", json.dumps(json.loads(item.data), indent=1)])
    text = path.read_text()
    begins = [match.start() for match in re.finditer('"1790000000"', text)]
    place = text.rindex('"', 0, begins[len(begins) // 2])
    path.write_text(text[:place] + text[place + 1 :])
    rows = [row for row in CsvAdapter().observations(path) if isinstance(row, TraceLine)]
    assert len(rows) == len(items) - 1


def test_last_messages_are_read_from_the_sqlite_journal(run: Path, tmp_path: Path) -> None:
    (path,) = write_bag2(tmp_path / "bag", of_run(run)).glob("*.db3")
    database = sqlite3.connect(path)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("UPDATE messages SET timestamp = timestamp + 1")
    database.execute("DELETE FROM messages WHERE id > 20")
    database.commit()
    left = tmp_path / "left"
    left.mkdir()
    for each in path.parent.glob(f"{path.name}*"):
        shutil.copy(each, left)
    database.close()
    assert (left / f"{path.name}-wal").exists()
    record = imported(tmp_path / "out", left)
    assert record.flights[0].agents[1].handler_runs == 19
    assert not remarks_of(record)


def test_damaged_row_does_not_affect_other_rows(run: Path, tmp_path: Path) -> None:
    path = write_csv(tmp_path / "records.csv", of_run(run, ("trace",)))
    rows = path.read_text().splitlines(keepends=True)
    first = [number for number, row in enumerate(rows) if ",1,trace" in row]
    rows[first[5]] = rows[first[5]][:80] + "\n"  # The quote is never closed.
    rows[first[8]] = "nonsense\n"
    rows[first[9]] = rows[first[9]].replace(",1,trace", ",x,trace")
    path.write_text("\ufeff" + "".join(rows).replace("\n", "\r\n"))
    record = imported(tmp_path / "out", path)
    assert record.flights[0].agents[1].handler_runs == len(first) - 4
    gaps = ingest_files([tmp_path / "out"]).largest().traces[1].gaps
    assert [gap.position for gap in gaps] == [4, 6], "the latter also for an agent that nobody knows"
    for said in ("row 7: it is damaged", "row 10: the row is damaged", "row 11: its agent is 'x'"):
        assert said in remarks_of(record)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_unquoted_json_in_a_row_is_read(run: Path, tmp_path: Path, separator: str) -> None:
    lines = trace_of(run, 1).read_text().splitlines()
    rows = [separator.join(("agent", "kind", "data")), *(f"1{separator}trace{separator}{line}" for line in lines)]
    (tmp_path / "1.csv").write_text("\n".join(rows))
    record = imported(tmp_path / "out", tmp_path / "1.csv")
    assert record.flights[0].agents[1].handler_runs == len(lines) - 1


def test_logged_events_are_imported(tmp_path: Path) -> None:
    (tmp_path / "events.csv").write_text("time_s,agent,kind,event,data\n1790000000.5,7,event,3,YWJj\n,7,event,3,YWJj\n")
    record = imported(tmp_path / "out", tmp_path / "events.csv")
    assert record.flights[0].agents[7].events == "agents/7.events.jsonl"
    assert "row 3: its time_s is '': use seconds since the Unix epoch" in remarks_of(record)
    (event,) = ingest_files([tmp_path / "out"]).largest().logged[7]
    assert (event.timestamp_us, event.event_id, event.data) == (1790000000500000, 3, b"abc")


def test_gap_is_kept_by_a_second_import(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run / "agents", tmp_path / "home")
    path = tmp_path / "home" / "1.trace.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[:6], b"?\n", *lines[7:-1], lines[-1][:30]]))
    imported(tmp_path / "out", tmp_path / "home")
    before, after = (
        ingest_files([directory]).largest().traces[1] for directory in (tmp_path / "home", tmp_path / "out")
    )
    assert after.gaps[:1] == before.gaps and after.runs == before.runs
    strict = read_trace(tmp_path / "out" / "agents" / "1.trace.jsonl")
    assert strict and strict.problem == "lines are lost at 7" and len(strict.runs) == 5


def test_truncated_trace_does_not_contradict_a_later_export(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run / "agents", tmp_path / "home")
    path = tmp_path / "home" / "1.trace.jsonl"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    imported(tmp_path / "out", tmp_path / "home")
    verdict_of = verdicts(tmp_path / "out")
    assert verdict_of["records"][0] == "not applicable" and verdict_of["1"][0] == "not applicable"
    (tmp_path / "home" / "1.chain.json").unlink()
    imported(tmp_path / "killed", tmp_path / "home")
    trace = read_trace(tmp_path / "killed" / "agents" / "1.trace.jsonl")
    assert trace and trace.cut_off and not trace.problem, "it may have been killed over it"


def test_subclass_may_use_other_topics(run: Path, tmp_path: Path) -> None:
    class OurBags(RosBag):
        topics: ClassVar = {"/ucp/{agent}/trace": "trace"}

    bag = write_bag2(tmp_path / "bag", of_run(run))
    record = import_records([bag], [OurBags()], tmp_path / "out")
    assert all(agent.trace and not agent.export for agent in record.flights[0].agents.values())
    assert "3 messages are on topics of no agent: /ucp/1/chain, " in remarks_of(record)


def test_messages_of_a_wrong_type_are_reported(run: Path, tmp_path: Path) -> None:
    class Wrong(RosBag):
        topics: ClassVar = {"/ucp/{agent}/trace": "sent", "/ucp/{agent}/chain": "chain"}

    record = import_records([write_bag1(tmp_path / "a.bag", of_run(run))], [Wrong()], tmp_path / "out")
    assert "it is not a UCP datagram (" in remarks_of(record)


def test_missing_package_is_reported(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rosbags.typesys", None)
    with pytest.raises(MachineError, match=r"pip install 'ucp-harness\[ros\]'") as caught:
        imported(tmp_path / "out", write_bag1(tmp_path / "a.bag", of_run(run)))
    assert caught.value.exit_status == 3 and not (tmp_path / "out").exists()


def test_trace_without_valid_lines_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("agent,kind,data\n" + "7,trace,hello\n" * 3)
    with pytest.raises(FieldError, match=r"its 3 line\(s\) of the trace of agent 7 hold no handler run"):
        imported(tmp_path / "out", tmp_path / "a.csv")


def test_each_unusable_file_is_reported(tmp_path: Path) -> None:
    for name in ("a.csv", "b.txt", "c.bag"):
        (tmp_path / name).write_text(f"hello {name}")
    done = harness("import", tmp_path, "-o", tmp_path / "out")
    assert done.returncode == 2
    assert len(sentences(done.stderr)) == 3 and all(name in done.stderr for name in ("a.csv", "b.txt", "c.bag"))


def test_trace_packed_with_zstd_names_the_solution(run: Path, tmp_path: Path) -> None:
    zstandard = pytest.importorskip("zstandard")
    (tmp_path / "1.trace.jsonl.zst").write_bytes(zstandard.compress((run / "agents/1.trace.jsonl").read_bytes()))
    record = imported(tmp_path / "home", tmp_path / "1.trace.jsonl.zst", run / "agents/1.chain.json")
    assert "it is no ROS bag, but another file that is packed with zstd: unpack it first" in remarks_of(record)


def test_failed_import_writes_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(FieldError, match="none of these files is a usable"):
        imported(tmp_path / "out", tmp_path / "a.bag")
    assert not (tmp_path / "out").exists()
