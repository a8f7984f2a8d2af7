"""Test that a directory in memory is removed even if all processes of its run are killed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from harness.play.memory_directory import memory_directory, remove_abandoned
from tests.harness.command import DEADLINE_S

PREFIX = f"ucp-test-{os.getpid()}-"
PROGRAM = """
import sys, time
from harness.play.memory_directory import memory_directory
with memory_directory(sys.argv[1]) as directory:
    (directory / "bundle").write_text("a secret")
    print(directory, flush=True)
    time.sleep(1000)
"""


@pytest.fixture
def killed() -> Iterator[Path]:
    """Return the directory of a process that was killed together with the guard of the directory."""
    run = subprocess.Popen([sys.executable, "-c", PROGRAM, PREFIX], stdout=subprocess.PIPE, text=True)
    assert run.stdout is not None
    directory = Path(run.stdout.readline().strip())
    for pid in (guard_of(directory), run.pid):
        os.kill(pid, signal.SIGKILL)
    run.communicate()
    yield directory
    remove_abandoned(PREFIX)


def guard_of(directory: Path) -> int:
    """Return the process ID of the guard of a directory. The arguments of the guard become visible shortly after its
    start.
    """
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        for entry in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # the process ended meanwhile
                if (entry / "cmdline").read_bytes().endswith(b"guard\0" + bytes(directory) + b"\0"):
                    return int(entry.name)
    raise AssertionError("no process guards the directory")


def test_next_directory_removes_that_of_killed_processes(killed: Path) -> None:
    assert (killed / "bundle").exists()
    with memory_directory(PREFIX):
        assert not killed.exists()


def test_directory_in_use_is_not_removed() -> None:
    with memory_directory(PREFIX) as directory:
        assert remove_abandoned(PREFIX) == []
        assert directory.exists()
    assert not directory.exists()


def test_link_to_a_directory_is_not_followed(tmp_path: Path) -> None:
    with memory_directory(PREFIX) as directory:
        link = directory.with_name(f"{PREFIX}link")
        link.symlink_to(tmp_path)
    try:
        assert remove_abandoned(PREFIX) == []
        assert tmp_path.exists()
    finally:
        link.unlink()
