"""Test compressed (packed) traces. Large traces are compressed during and after the run, all readers accept compressed
traces, and no reader judges a damaged one.
"""

import gzip
import os
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from harness import checker
from harness.archive import bounded_file, trace_files
from harness.archive.archive import RunArchive
from harness.archive.bounded_file import can_free_parts, has_finished_part, pack_parts, packed_name
from harness.archive.trace_files import open_trace, pack_traces, packable_traces
from harness.backend_names import BackendName
from harness.field.depot.mission_comparison import compare
from harness.play.process import _program_run
from harness.play.progress import SilentProgress
from harness.play.simulation import run_files
from harness.run.run import run
from tests.harness.command import harness
from tests.harness.report.live.runs import film
from tests.harness.virtual import scenario

ASKED = scenario(agents=3, duration_s=200, events={"source": "random", "mean_s": 5}, network={"loss": 0.1})
NAMES = [f"{number}.trace.jsonl" for number in (1, 2, 3)]


def silent(step: str) -> None:
    pass


def names(directory: Path) -> list[str]:
    return sorted(path.name for path in (directory / "agents").iterdir() if ".trace." in path.name)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(ASKED, 1, tmp_path_factory.mktemp("plain") / "run", SilentProgress(), "sim").directory


@pytest.fixture
def packed(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(trace_files, "PACKED_FROM_BYTES", 0)
    directory = shutil.copytree(plain, tmp_path / "run")
    pack_traces(directory / "agents", silent)
    return directory


def test_run_packs_only_large_traces(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert names(plain) == NAMES
    monkeypatch.setattr(trace_files, "PACKED_FROM_BYTES", 100_000)
    large = run(ASKED, 1, tmp_path / "run", SilentProgress(), "sim").directory
    assert names(large) == [f"{name}.gz" for name in NAMES]
    for name in NAMES:
        assert gzip.decompress((large / "agents" / f"{name}.gz").read_bytes()) == (plain / "agents" / name).read_bytes()


@pytest.fixture
def partly_packed(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a run whose harness was killed. Each trace is compressed except for its end."""
    monkeypatch.setattr(trace_files, "PACKED_FROM_BYTES", 0)
    monkeypatch.setattr(bounded_file, "PART_BYTES", 65536)
    monkeypatch.setattr(bounded_file, "KEPT_BYTES", 1)
    directory = shutil.copytree(plain, tmp_path / "run")
    if not can_free_parts(directory):
        pytest.skip("this file system cannot free a part of a file")
    traces = packable_traces(directory / "agents")
    assert [path.name for path in traces] == NAMES
    for path in traces:
        pack_parts(path)
        assert not has_finished_part(path)
        assert path.read_bytes().startswith(bytes(65536))
        assert path.stat().st_blocks * 512 < path.stat().st_size
    return directory


@pytest.fixture
def copied(partly_packed: Path, tmp_path: Path) -> Path:
    """Return a copy of the run `partly_packed`. In the copied files, the parts that the harness freed contain zeros."""
    return shutil.copytree(partly_packed, tmp_path / "copied")


@pytest.mark.parametrize("directory", ["packed", "partly_packed", "copied"])
def test_all_readers_take_packed_traces(plain: Path, directory: str, request: pytest.FixtureRequest) -> None:
    packed = request.getfixturevalue(directory)

    def facts(directory: Path) -> list[Any]:
        archive = RunArchive(directory)
        result = checker.check(archive)
        changes = [change for change in film(directory) if change[0] != "run"]
        lines = [line.text for agent in (1, 2, 3) for line in archive.trace_lines(agent)]
        kinds = Counter(file.kind for file in compare([directory]).files)
        return [result, archive.epoch_us, lines, [*archive.handler_runs()], changes, kinds]

    assert facts(packed) == facts(plain)
    assert harness("diff", plain, packed).returncode == 0
    for command in ("replay", "validate", "report"):
        done = harness(command, packed)
        complaints = [line for line in done.stderr.splitlines() if not line.endswith("checked")]  # progress
        assert (done.returncode, complaints) == (0, [])
    again = packed.with_name("imported")
    assert "3 trace(s)" in harness("import", packed, "--out", again).stdout
    (trace,) = (path for path in trace_files.trace_files(packed / "agents") if path.name.startswith("2."))
    assert "no difference" in harness("replay", trace).stdout


@pytest.mark.parametrize("cut", [0.5, 0.99])
def test_run_with_a_truncated_packed_trace_is_not_judged(packed: Path, cut: float) -> None:
    path = packed / "agents" / "2.trace.jsonl.gz"
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * cut)])
    result = checker.check(RunArchive(packed))
    assert any("the gzip data ends early" in error for error in result.errors)
    assert [result.judgements[key].verdict for key in ("1", "steps", "records")] == ["not applicable"] * 3


def test_ctrl_c_keeps_the_traces_that_are_not_packed_yet(packed: Path) -> None:
    for name in NAMES:
        (packed / "agents" / name).write_bytes(gzip.decompress((packed / "agents" / f"{name}.gz").read_bytes()))
        (packed / "agents" / f"{name}.gz").unlink()

    def interrupt(step: str) -> None:
        if step == "packing trace 2 of 3":
            raise KeyboardInterrupt

    pack_traces(packed / "agents", interrupt)
    assert names(packed) == [f"{NAMES[0]}.gz", *NAMES[1:]]


def test_traces_that_are_partly_packed_are_packed_completely(plain: Path, partly_packed: Path) -> None:
    pack_traces(partly_packed / "agents", silent)
    assert names(partly_packed) == [f"{name}.gz" for name in NAMES]
    for name in NAMES:
        content = gzip.decompress((partly_packed / "agents" / f"{name}.gz").read_bytes())
        assert content == (plain / "agents" / name).read_bytes()


def test_agent_and_reader_notice_nothing_of_packed_parts(plain: Path, partly_packed: Path) -> None:
    """Let the agent append lines between two compressions of its trace. A reader that is open at the same time reads
    each line once.
    """
    path, whole = partly_packed / "agents" / NAMES[0], (plain / "agents" / NAMES[0]).read_bytes()
    read = b""
    with open_trace(path) as early, path.open("ab", buffering=0) as agent:
        for _ in range(4):
            read += early.read(20_000)
            agent.write(whole)
            pack_parts(path)
            assert agent.tell() == path.stat().st_size
        read += early.read()
    with open_trace(path) as late:
        assert late.read() == read == whole * 5
    assert path.stat().st_blocks * 512 + packed_name(path).stat().st_size < len(whole) * 5 / 2


def test_run_packs_its_traces_while_it_plays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    packed: list[Path] = []
    monkeypatch.setattr(run_files, "PACKED_FROM_BYTES", 100_000)
    monkeypatch.setattr(run_files, "packable_traces", trace_files._plain_traces)
    monkeypatch.setattr(run_files, "pack_parts", packed.append)
    run(ASKED, 1, tmp_path / "run", SilentProgress(), "sim")
    assert [path.name for path in packed[:3]] == NAMES


@pytest.mark.parametrize(
    "backend", [pytest.param("process", marks=pytest.mark.lab), pytest.param("docker", marks=pytest.mark.docker)]
)
def test_programs_are_judged_alike_if_their_traces_are_packed_meanwhile(
    backend: BackendName, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Restart an agent, so that the harness appends to a trace of which some parts are already compressed."""
    monkeypatch.setattr(trace_files, "PACKED_FROM_BYTES", 1)
    monkeypatch.setattr(bounded_file, "PART_BYTES", 4096)
    monkeypatch.setattr(bounded_file, "KEPT_BYTES", 4096)
    monkeypatch.setattr(_program_run, "PACK_S", 0.1)
    packed: list[Path] = []

    def pack_and_note(path: Path) -> None:
        pack_parts(path)
        packed.append(path)

    monkeypatch.setattr(_program_run, "pack_parts", pack_and_note)
    timeline = [{"at_s": 150, "kill": [2]}, {"at_s": 160, "restart": [2]}]
    keys = {"vehicles": {"kind": "none"}, "speedup": 60, "timeline": timeline}
    keys |= {"docker": {"image_from_host": True}} if backend == "docker" else {}
    replaced = scenario(agents=3, duration_s=300, events={"source": "random", "mean_s": 5}, **keys)
    finished = run(replaced, 1, tmp_path / "run", SilentProgress(), backend)
    assert {path.name for path in packed} == set(NAMES)
    assert names(finished.directory) == [f"{name}.gz" for name in NAMES]
    assert finished.result.errors == []
    for key in ("1", "2", "3", "4", "records"):
        assert finished.result.judgements[key].kind == "good", finished.result.judgements[key]


def test_link_of_an_agent_never_frees_parts_of_another_file(tmp_path: Path) -> None:
    """The harness uses a link to the trace of an agent in a container. The agent can replace this file."""
    own, other = tmp_path / "1-1" / NAMES[0], tmp_path / "other"
    own.parent.mkdir()
    other.write_bytes(b"x" * 4_000_000)
    own.symlink_to(other)
    (tmp_path / NAMES[0]).symlink_to(f"1-1/{NAMES[0]}")
    os.mkfifo(tmp_path / NAMES[1])
    for path in (tmp_path / NAMES[0], tmp_path / NAMES[1]):
        assert not has_finished_part(path)
        with pytest.raises(OSError, match=r"symbolic links|not a regular file"):
            pack_parts(path)
    assert other.read_bytes() == b"x" * 4_000_000
