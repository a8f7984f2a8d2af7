"""One archive for all: whoever reads a run, whatever has become of it, is told the same."""

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
from harness.errors import HarnessError, RunDirectoryError
from harness.play.progress import Silent
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
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three agents in virtual time."""
    asked = scenario(agents=3, duration_s=300, network={"loss": 0.3})
    return run(asked, 3, tmp_path_factory.mktemp("whole") / "run", Silent(), backend="sim").directory


def lose(path: Path, _: float) -> None:
    path.unlink(missing_ok=True)


def cut(path: Path, where: float) -> None:
    if path.exists():
        content = path.read_bytes()
        path.write_bytes(content[: int(where * len(content))])


def cut_at_a_line(path: Path, where: float) -> None:
    if path.exists():
        lines = path.read_bytes().splitlines(keepends=True)
        path.write_bytes(b"".join(lines[: int(where * len(lines))]))


def spoil(path: Path, where: float) -> None:
    if path.exists() and (content := bytearray(path.read_bytes())):
        content[int(where * len(content))] ^= 0x15
        path.write_bytes(content)


def put_in_the_place_of_the_first(path: Path, _: float) -> None:
    if path.exists() and path.parent.name == "agents":
        path.with_name(f"1{path.name[1:]}").write_bytes(path.read_bytes())


def of_another_version(path: Path, _: float) -> None:
    if path.exists():
        path.write_bytes(path.read_bytes().replace(b'/1"', b'/9"', 1))


DAMAGES = [lose, cut, cut_at_a_line, spoil, put_in_the_place_of_the_first, of_another_version]
DAMAGE = st.tuples(st.sampled_from(DAMAGES), st.sampled_from(FILES), st.floats(0, 1, exclude_max=True))


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damages=st.lists(DAMAGE, min_size=1, max_size=3), large=st.booleans())
def test_all_tools_say_the_same_of_a_damaged_run(
    whole: Path, tmp_path_factory: pytest.TempPathFactory, damages: list[Any], large: bool
) -> None:
    directory = tmp_path_factory.mktemp("damaged") / "run"
    shutil.copytree(whole, directory)
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
    """What the report says is damaged or missing; None if it refuses a record of another version."""
    try:
        remains = read_source(RunArchive(directory, skim=True))
    except RunDirectoryError as error:
        assert "its schema is" in str(error) or not [*(directory / "agents").glob("*.json")]
        return None
    of_agents = [sentence for sentence in remains.chains_missing if re.match(r"agents? \d", sentence)]
    network = remains.network.problems
    return {*remains.chains_missing, *remains.files_missing} - {*of_agents, *network}


def logged(directory: Path) -> set[str]:
    return set(told_by(lambda: logbook.read(RunArchive(directory)).errors))


def compared(directory: Path) -> set[str]:
    ended = "the end of the run is not recorded"
    return {error for error in told_by(lambda: compare(directory, directory).errors) if ended not in error}


def told_by(ask: Callable[[], list[str]]) -> Iterator[str]:
    """What a tool tells of a run; one that refuses it has its own sentence."""
    try:
        yield from ask()
    except HarnessError:
        return


def test_a_whole_run_has_neither_problems_nor_gaps(whole: Path) -> None:
    archive = RunArchive(whole)
    assert (archive.problems, archive.gaps) == ([], [])
    assert archive.roster == [1, 2, 3] == [*archive.traces] == [*archive.exports.by_agent]


def test_files_from_the_field_may_have_any_names(whole: Path, tmp_path: Path) -> None:
    for agent, name in ((1, "1"), (2, "the blue one"), (3, "unnamed (2)")):
        for kind in ("chain.json", "trace.jsonl"):
            shutil.copy(whole / "agents" / f"{agent}.{kind}", tmp_path / f"{name}.{kind}")
    archive = RunArchive(tmp_path)
    assert archive.problems == []
    assert [*archive.traces] == [*archive.exports.by_agent] == [1, 2, 3]


def test_the_record_is_found_in_whichever_directory_has_it(whole: Path, tmp_path: Path) -> None:
    shutil.copy(whole / "agents" / "2.chain.json", tmp_path)
    (whole / "agents" / "2.chain.json").rename(moved := whole / "agents" / "2.chain.away")
    try:
        archive = RunArchive(tmp_path, whole)
        assert archive.recorded
        assert archive.directory == whole
        assert [*archive.exports.by_agent] == [*archive.traces] == [1, 2, 3]
    finally:
        moved.rename(whole / "agents" / "2.chain.json")


def test_a_run_without_a_record_is_reported_with_whoever_left_a_trace(whole: Path, tmp_path: Path) -> None:
    directory = tmp_path / "run"
    shutil.copytree(whole, directory)
    (directory / "run.json").write_text("{")
    (directory / "agents" / "3.trace.jsonl").rename(directory / "agents" / "another name.trace.jsonl")
    (directory / "agents" / "3.chain.json").unlink()
    assert write_report(RunArchive(directory)).exists()


def test_what_skimming_leaves_out_is_told_all_the_same(whole: Path, tmp_path: Path) -> None:
    directory = tmp_path / "run"
    shutil.copytree(whole, directory)
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


def noting(reader: Callable[..., Any], read: list[object]) -> Callable[..., Any]:
    """The reader, which notes what it is asked for."""

    def reads(what: Any, **options: Any) -> Any:
        what = what if isinstance(what, Path) else tuple(what)
        read.append(what)
        return reader(what, **options)

    return reads


def test_each_file_is_read_once(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[object] = []
    for reader in ("read_trace", "read_record", "read_exports"):
        monkeypatch.setattr(archive_module, reader, noting(getattr(archive_module, reader), read))
    archive = RunArchive(whole)
    checker.check(checker.gather(archive))
    remains = read_source(archive)
    assert remains.traces
    assert remains.files_missing == remains.chains_missing == []
    assert len(read) == len({*map(str, read)}) == 3 + 1 + 2  # exports at the end, and before a final reconcile
