"""Test the archive of a run: all commands report the same problems of a complete or damaged run.

Test the run directory: it must be new or empty, and traces of restarted agents are appended.
"""

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness import checker
from harness.archive import archive as archive_module
from harness.archive.archive import RunArchive
from harness.archive.directory import RunDirectory, claim
from harness.errors import HarnessError, RunDirectoryError
from harness.play.progress import SilentProgress
from harness.report import logbook, read_source, write_report
from harness.report.difference import compare
from harness.run.run import run
from tests.harness.virtual import scenario

FILES = [
    "run.json",
    "network.jsonl",
    *(f"agents/{agent}.{kind}" for agent in (1, 2, 3) for kind in ("chain.json", "trace.jsonl")),
]


@pytest.fixture(scope="module")
def intact_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Play a run of three agents in virtual time, without damage."""
    asked = scenario(agents=3, duration_s=300, network={"loss": 0.3})
    return run(asked, 3, tmp_path_factory.mktemp("whole") / "run", SilentProgress(), backend="sim").directory


def delete(path: Path, _: float) -> None:
    path.unlink(missing_ok=True)


def truncate(path: Path, where: float) -> None:
    if path.exists():
        content = path.read_bytes()
        path.write_bytes(content[: int(where * len(content))])


def truncate_at_line(path: Path, where: float) -> None:
    if path.exists():
        lines = path.read_bytes().splitlines(keepends=True)
        path.write_bytes(b"".join(lines[: int(where * len(lines))]))


def corrupt(path: Path, where: float) -> None:
    if path.exists() and (content := bytearray(path.read_bytes())):
        content[int(where * len(content))] ^= 0x15
        path.write_bytes(content)


def replace_first_export(path: Path, _: float) -> None:
    if path.exists() and path.parent.name == "agents":
        path.with_name(f"1{path.name[1:]}").write_bytes(path.read_bytes())


def change_schema(path: Path, _: float) -> None:
    if path.exists():
        path.write_bytes(path.read_bytes().replace(b'/1"', b'/9"', 1))


DAMAGES = [delete, truncate, truncate_at_line, corrupt, replace_first_export, change_schema]
DAMAGE = st.tuples(st.sampled_from(DAMAGES), st.sampled_from(FILES), st.floats(0, 1, exclude_max=True))


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damages=st.lists(DAMAGE, min_size=1, max_size=3), large=st.booleans())
def test_all_commands_report_the_same_problems_of_a_damaged_run(
    intact_run: Path, tmp_path_factory: pytest.TempPathFactory, damages: list[Any], large: bool
) -> None:
    directory = tmp_path_factory.mktemp("damaged") / "run"
    shutil.copytree(intact_run, directory)
    for damage, name, where in damages:
        damage(directory / name, where)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(archive_module, "LARGE_BYTES", 0 if large else 1 << 30)
        archive = RunArchive(directory)
        evidence = checker.gather(RunArchive(directory))
        checked = {error.removesuffix("; the exports are checked without it") for error in evidence.errors}
        assert checked == {*archive.problems}
        assert checker.check(evidence).errors == evidence.errors
        assert reported(directory) in (None, {*map(archive.within, [*archive.problems, *archive.gaps])})
        assert logged(directory) <= {*archive.problems}
        assert compared(directory) <= {*archive.problems}
    shutil.rmtree(directory.parent)


def reported(directory: Path) -> set[str] | None:
    """Return the damaged or missing files that the report names. Return None if the report rejects run.json."""
    try:
        remains = read_source(RunArchive(directory, skim=True))
    except RunDirectoryError as error:
        assert "its schema is" in str(error) or not [*(directory / "agents").glob("*.json")]
        return None
    of_agents = [sentence for sentence in remains.chains_missing if re.match(r"agents? \d", sentence)]
    network = remains.network.problems
    return {*remains.chains_missing, *remains.files_missing} - {*of_agents, *network}


def logged(directory: Path) -> set[str]:
    return set(problems_of(lambda: logbook.read(RunArchive(directory)).errors))


def compared(directory: Path) -> set[str]:
    ended = "the end of the run is not recorded"
    return {error for error in problems_of(lambda: compare(directory, directory).errors) if ended not in error}


def problems_of(command: Callable[[], list[str]]) -> Iterator[str]:
    """Yield the problems that a command reports.

    A command that rejects the run raises an error with its own sentence.
    """
    try:
        yield from command()
    except HarnessError:
        return


def test_intact_run_has_neither_problems_nor_gaps(intact_run: Path) -> None:
    archive = RunArchive(intact_run)
    assert (archive.problems, archive.gaps) == ([], [])
    assert archive.roster == [1, 2, 3] == [*archive.traces] == [*archive.exports.by_agent]


def test_archive_reads_exports_with_any_file_name(intact_run: Path, tmp_path: Path) -> None:
    for agent, name in ((1, "1"), (2, "the blue one"), (3, "unnamed (2)")):
        for kind in ("chain.json", "trace.jsonl"):
            shutil.copy(intact_run / "agents" / f"{agent}.{kind}", tmp_path / f"{name}.{kind}")
    archive = RunArchive(tmp_path)
    assert archive.problems == []
    assert [*archive.traces] == [*archive.exports.by_agent] == [1, 2, 3]


def test_archive_finds_the_record_in_any_given_directory(intact_run: Path, tmp_path: Path) -> None:
    shutil.copy(intact_run / "agents" / "2.chain.json", tmp_path)
    (intact_run / "agents" / "2.chain.json").rename(moved := intact_run / "agents" / "2.chain.away")
    try:
        archive = RunArchive(tmp_path, intact_run)
        assert archive.recorded
        assert archive.directory == intact_run
        assert [*archive.exports.by_agent] == [*archive.traces] == [1, 2, 3]
    finally:
        moved.rename(intact_run / "agents" / "2.chain.json")


def test_report_of_run_without_record_lists_agents_with_traces(intact_run: Path, tmp_path: Path) -> None:
    directory = tmp_path / "run"
    shutil.copytree(intact_run, directory)
    (directory / "run.json").write_text("{")
    (directory / "agents" / "3.trace.jsonl").rename(directory / "agents" / "another name.trace.jsonl")
    (directory / "agents" / "3.chain.json").unlink()
    assert write_report(RunArchive(directory)).exists()


def test_skimmed_archive_reports_the_same_problems(intact_run: Path, tmp_path: Path) -> None:
    directory = tmp_path / "run"
    shutil.copytree(intact_run, directory)
    trace = directory / "agents" / "2.trace.jsonl"
    lines = trace.read_bytes().splitlines(keepends=True)
    taken_in = next(number for number, line in enumerate(lines) if b'"changes":[],' in line and b'"receive_' in line)
    lines[taken_in] = lines[taken_in].replace(b'"changes":[],', b'"changes":[],,')
    trace.write_bytes(b"".join(lines))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(archive_module, "LARGE_BYTES", 0)
        skimmed, read = RunArchive(directory, skim=True), RunArchive(directory)
        assert (
            skimmed.problems == read.problems == [f"{trace}: line {taken_in + 1} is damaged; the part before is read"]
        )
        assert len(skimmed.traces[1].runs) < len(read.traces[1].runs)


def recording(reader: Callable[..., Any], read: list[object]) -> Callable[..., Any]:
    """Return a wrapper around the reader that records each path that it reads."""

    def recorded(what: Any, **options: Any) -> Any:
        what = what if isinstance(what, Path) else tuple(what)
        read.append(what)
        return reader(what, **options)

    return recorded


def test_archive_reads_each_file_once(intact_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[object] = []
    for reader in ("read_trace", "read_record", "read_exports"):
        monkeypatch.setattr(archive_module, reader, recording(getattr(archive_module, reader), read))
    archive = RunArchive(intact_run)
    checker.check(checker.gather(archive))
    remains = read_source(archive)
    assert remains.traces
    assert remains.files_missing == remains.chains_missing == []
    assert len(read) == len({*map(str, read)}) == 3 + 1 + 2  # exports at the end, and before a final reconcile


def test_run_directory_refuses_a_directory_with_files(tmp_path: Path) -> None:
    (tmp_path / "kept").touch()
    with pytest.raises(RunDirectoryError, match="is not empty: choose another --out"):
        claim(tmp_path)
    with pytest.raises(RunDirectoryError, match="is not a directory"):
        claim(tmp_path / "kept")
    claim(tmp_path / "new" / "one", tmp_path / "new" / "one" / "inner")
    assert (tmp_path / "new" / "one" / "inner").is_dir()


def test_trace_of_later_incarnation_follows_complete_lines(tmp_path: Path) -> None:
    rundir = RunDirectory(tmp_path / "run")
    first, second = rundir.agent(7), rundir.agent(7, incarnation=2)
    assert (first.name, second.name) == ("agents", "7-2")
    (first / "7.trace.jsonl").write_text("one\ntw")
    (second / "7.trace.jsonl").write_text("three\n")
    rundir.append_trace(7, second)
    assert (first / "7.trace.jsonl").read_text() == "one\nthree\n"
    assert (second / "7.trace.jsonl").read_text() == "three\n"
    rundir.append_trace(7, rundir.agent(7, incarnation=3))  # This incarnation was killed before it wrote a trace.
    assert (first / "7.trace.jsonl").read_text() == "one\nthree\n"


def test_trace_of_running_incarnation_is_appended_in_parts(tmp_path: Path) -> None:
    rundir = RunDirectory(tmp_path / "run")
    first, second = rundir.agent(7), rundir.agent(7, incarnation=2)
    (first / "7.trace.jsonl").write_text("one\n")
    (second / "7.trace.jsonl").write_text("two\nthr")
    copied_bytes = rundir.append_trace(7, second)
    (second / "7.trace.jsonl").write_text("two\nthree\n")
    copied_bytes += rundir.append_trace(7, second, copied_bytes)
    assert (first / "7.trace.jsonl").read_text() == "one\ntwo\nthree\n"
    assert rundir.append_trace(7, second, copied_bytes) == 0
