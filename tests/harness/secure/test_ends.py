"""The ends of secured runs: no signal leaves a secret in a file."""

import json
import os
import resource
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness.command import Running, write_scenario

pytestmark = pytest.mark.lab

MEMORY = Path("/dev/shm")  # noqa: S108


def key_directories() -> set[Path]:
    return {path for place in (MEMORY, Path(tempfile.gettempdir())) for path in place.glob("ucp-keys-*")}


def _allow_hang_up_and_core_files() -> None:
    """Undo an ignored SIGHUP, which a program inherits under nohup, and a limit for core files."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (resource.getrlimit(resource.RLIMIT_CORE)[1],) * 2)


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Running]:
    scenario = write_scenario(tmp_path, security={}, speedup=20, duration_s=2000)
    asked = Running(
        scenario,
        tmp_path / "run",
        *("--backend", "process"),
        preexec_fn=_allow_hang_up_and_core_files,
    )
    yield asked
    asked.process.kill()
    asked.process.communicate()


def test_hang_up_ends_the_run_with_exports_and_without_keys(run: Running) -> None:
    before = key_directories()
    run.wait_for_mission(1, 2, 3)
    run.process.send_signal(signal.SIGHUP)
    status, _, err = run.end()
    assert (status, "Traceback" in err) == (130, False), err
    assert run.record()["characteristics"]
    assert len([*(run.out / "agents").glob("*.chain.json")]) == 3
    assert key_directories() <= before


def test_aborted_agent_with_keys_leaves_no_core_file(run: Running) -> None:
    before = key_directories()
    run.wait_for_mission(1, 2, 3)
    run.signal_agent(3, signal.SIGABRT)
    status, _, err = run.end()
    assert (status, "agent 3 ended by itself with SIGABRT" in err) == (1, True), err
    assert not [path for path in run.out.rglob("*") if path.name.startswith("core")]
    assert key_directories() <= before


def test_killed_run_leaves_no_keys(run: Running) -> None:
    run.wait_for_mission(1)
    (mission,) = [json.loads(path.read_text()) for path in (run.out / "agents").glob("1.mission.json")]
    bundle = Path(os.path.normpath(run.out / "agents" / mission["security"]["bundle"]))
    assert bundle.exists() and bundle.is_relative_to(MEMORY)
    run.process.kill()
    run.process.wait()
    run.process.poll = lambda: None  # type: ignore[method-assign]  # wait_for expects an active run
    run.wait_for(lambda: not bundle.parent.parent.exists(), "the end of the keys")
