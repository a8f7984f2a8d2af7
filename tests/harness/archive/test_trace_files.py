"""Large traces are packed after the run. All readers take packed traces, and a damaged one is never judged to hold."""

import gzip
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from harness import checker
from harness.archive import trace_files
from harness.archive.archive import RunArchive
from harness.archive.trace_files import pack_traces
from harness.field.depot.mission_comparison import compare
from harness.play.progress import SilentProgress
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


def test_all_readers_take_packed_traces(plain: Path, packed: Path) -> None:
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
        assert (done.returncode, done.stderr) == (0, "")
    again = packed.with_name("imported")
    assert "3 trace(s)" in harness("import", packed, "--out", again).stdout
    assert "no difference" in harness("replay", packed / "agents" / "2.trace.jsonl.gz").stdout


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
