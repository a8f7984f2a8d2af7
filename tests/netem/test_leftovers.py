"""Test that nothing remains of a virtual network whose owner is killed at any moment."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from netem.lab import Lab
from tests.netem.conftest import DEADLINE_S, play, until

pytestmark = pytest.mark.lab

_RANDOM = random.Random(7)
BARE = Path(__file__).with_name("bare.py")
MOMENTS = [0.0, *(round(_RANDOM.uniform(0.02, 0.6), 3) for _ in range(6))]
NAMESPACES = ("net", "user", "mnt", "pid")


def processes_of(mark: Path) -> set[int]:
    """Return the running processes of this user whose environment contains the mark."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if f"UCP_TEST_MARK={mark}".encode() in (folder / "environ").read_bytes():
                found.add(int(folder.name))
        except OSError:
            continue
    return found


def namespaces() -> set[str]:
    """Return each namespace that contains a running process."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if not has_ended(folder):
                found |= {str((folder / "ns" / kind).readlink()) for kind in NAMESPACES}
    return found


def has_ended(folder: Path) -> bool:
    """Return whether the process is a zombie. In the file, the state follows the name of the program (proc(5))."""
    return (folder / "stat").read_text().rpartition(")")[2].split()[0] == "Z"


def interfaces() -> set[str]:
    return {path.name for path in Path("/sys/class/net").iterdir()}


@contextmanager
def orchestrator_in(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start `bare.py` in the folder, and kill it if the test fails. The folder's name marks all its processes."""
    env = {**os.environ, "UCP_TEST_MARK": str(folder)}
    with subprocess.Popen([sys.executable, str(BARE), str(folder)], stdout=subprocess.PIPE, env=env) as orchestrator:
        try:
            yield orchestrator
        except BaseException:
            orchestrator.kill()
            raise


@pytest.mark.parametrize("after_s", MOMENTS)
def test_killed_orchestrator_leaves_nothing(tmp_path: Path, after_s: float) -> None:
    before = interfaces()
    with orchestrator_in(tmp_path) as orchestrator:
        assert orchestrator.stdout is not None
        assert orchestrator.stdout.readline() == b"opening\n"
        time.sleep(after_s)  # the time of the kill is the input of this test; the test waits for nothing
        marked = processes_of(tmp_path)
        inhabited = namespaces_of(marked)
        during = interfaces()
        orchestrator.kill()
    assert orchestrator.pid in marked, "the mark does not show, so its absence would prove nothing"
    assert str(Path("/proc/self/ns/net").readlink()) in namespaces(), "nor would the absence of a namespace"
    assert during == before
    play(until(lambda: not processes_of(tmp_path), "every process is gone"))
    play(until(lambda: not inhabited & namespaces(), "every namespace is gone"))
    assert interfaces() == before
    assert {path.suffix for path in tmp_path.iterdir()} <= {".log"}


def namespaces_of(pids: set[int]) -> set[str]:
    """Return the namespaces of these processes. The namespaces of the present process are left out."""
    own = {str(Path("/proc/self/ns", kind).readlink()) for kind in NAMESPACES}
    found = set()
    for pid in pids:
        for kind in NAMESPACES:
            try:
                found.add(str(Path(f"/proc/{pid}/ns/{kind}").readlink()))
            except OSError:
                continue
    return found - own


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_stopped_lab_with_programs_is_removed_after_its_orchestrator(tmp_path: Path, number: signal.Signals) -> None:
    with orchestrator_in(tmp_path) as orchestrator:
        assert orchestrator.stdout is not None
        while orchestrator.stdout.readline() != b"full\n":
            assert orchestrator.poll() is None
        # The orchestrator, setpriv's unshare, its init, and two of each program at least, once they have begun.
        play(until(lambda: len(processes_of(tmp_path)) >= 3 + 6 * 2, "all programs run"))
        everybody = processes_of(tmp_path)
        for pid in everybody - {orchestrator.pid}:
            with suppress(ProcessLookupError):  # a program that sets conditions ends by itself
                os.kill(pid, signal.SIGSTOP)
        orchestrator.send_signal(number)
    play(until(lambda: not processes_of(tmp_path), "every process is gone"))


def test_closed_lab_leaves_nothing(tmp_path: Path) -> None:
    before = interfaces()

    async def run() -> None:
        lab = await Lab.open([1, 2], log=tmp_path / "lab.log")
        env = {"PATH": os.environ["PATH"], "UCP_TEST_MARK": str(tmp_path)}
        await lab.spawn(1, ["/bin/sleep", "1000"], cwd=tmp_path, env=env, stdout=tmp_path / "o", stderr=tmp_path / "o")
        await until(lambda: processes_of(tmp_path), "the program runs")
        await asyncio.wait_for(lab.close(), DEADLINE_S)
        assert not processes_of(tmp_path)

    play(run())
    assert interfaces() == before
    assert {path.name for path in tmp_path.iterdir()} == {"lab.log", "o"}


def test_cancelled_opening_of_a_lab_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UCP_TEST_MARK", str(tmp_path))

    async def run() -> None:
        opening = asyncio.create_task(Lab.open([1, 2], log=tmp_path / "lab.log"))
        await until(lambda: processes_of(tmp_path), "the first process runs")
        opening.cancel()
        with pytest.raises(asyncio.CancelledError):
            await opening
        assert not processes_of(tmp_path)

    play(run())
