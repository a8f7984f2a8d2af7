"""Test the ends of secured runs: no file contains a secret afterwards, whatever signal ended the run."""

import json
import os
import resource
import signal
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from harness.play.keyring.key_directory import KeyDirectory
from tests.harness.command import Running, harness, processes, write_scenario
from tests.harness.play.test_memory_directory import guard_of
from tests.harness.secure.secrets import leaks, secrets

pytestmark = pytest.mark.lab

MEMORY = Path("/dev/shm")  # noqa: S108


def key_directories() -> set[Path]:
    return {path for place in (MEMORY, Path(tempfile.gettempdir())) for path in place.glob("ucp-keys-*")}


def bundle_of(run: Running, agent: int) -> Path:
    """Return the path of the file with an agent's keys. The agent's mission file names this path."""
    mission = json.loads((run.out / "agents" / f"{agent}.mission.json").read_text())
    return Path(os.path.normpath(run.out / "agents" / mission["security"]["bundle"]))


def _allow_hang_up_and_core_files() -> None:
    """Restore the default for SIGHUP, which nohup makes a program ignore, and remove the limit for core files."""
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
    bundle = bundle_of(run, 1)
    assert bundle.exists() and bundle.is_relative_to(MEMORY)
    run.process.kill()
    run.process.wait()
    run.process.poll = lambda: None  # type: ignore[method-assign]  # wait_for expects an active run
    run.wait_for(lambda: not bundle.parent.parent.exists(), "the end of the keys")


def test_clean_removes_the_keys_of_a_run_that_was_killed_with_its_guard(run: Running) -> None:
    run.wait_for_mission(1)
    keys = bundle_of(run, 1).parent.parent
    for pid in (guard_of(keys), run.process.pid):
        os.kill(pid, signal.SIGKILL)
    run.process.wait()
    assert keys.exists()
    assert f"removed {keys}" in harness("clean").stdout
    assert not keys.exists()


def test_arguments_and_environment_of_processes_contain_no_secret(tmp_path: Path) -> None:
    home = KeyDirectory.new(tmp_path / "keys", [1, 2, 3], seals=True, epoch_s=600.0)
    asked = write_scenario(tmp_path, security={"keys": str(home.directory)}, speedup=20, duration_s=2000)
    run = Running(asked, tmp_path / "run", "--backend", "process")
    try:
        run.wait_for_mission(1, 2, 3)
        shown = [content for pid in (run.process.pid, *processes(run.out)) for content in visible(pid)]
    finally:
        run.process.kill()
        run.process.communicate()
    assert sum(b"mission.json" in content for _, content in shown) >= 3
    assert any(b"PATH=" in content for _, content in shown)
    assert leaks(secrets(home, 2), shown) == []


def visible(pid: int) -> Iterator[tuple[str, bytes]]:
    """Yield the arguments and the environment of a process, as far as other programs of the same user can read them."""
    for name in ("cmdline", "environ"):
        with suppress(OSError):  # a process with keys denies access to other programs
            yield f"{name} of process {pid}", Path(f"/proc/{pid}/{name}").read_bytes()
