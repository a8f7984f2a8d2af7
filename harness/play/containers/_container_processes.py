"""List the processes of a container from outside, and end the program of a container. After the end of the program, the
harness can still list the processes that the program left behind.

The first process of a container, docker-init, ends together with its program. The kernel then kills all other processes
of the container, before any other process could list them. Therefore the harness suspends docker-init while it ends the
program.
"""

import os
import select
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from harness.play._child_processes import GRACE_S, RETRY_S
from harness.play.containers.docker_engine import DockerEngine

PROC = Path("/proc")


def first_process(engine: DockerEngine, identity: str) -> int | None:
    """Return the process ID of the container's first process. Return None if the process does not run on this
    machine.
    """
    pid: int = engine.do("look at a container", engine.api.inspect_container, identity)["State"]["Pid"]
    with suppress(OSError):
        if identity in (PROC / str(pid) / "cgroup").read_text():  # the process ID may belong to another process
            return pid
    return None


def end_program(init: int, grace_s: float) -> list[str]:
    """End the program that `init`, the first process of a container, started. Return the names of the processes that
    the program left behind.

    The function sends SIGTERM to the program, and SIGKILL if the program still runs after `grace_s` seconds of wall
    time. If SIGKILL was necessary, the list is empty, because a killed program cannot end its own processes. The
    container ends when this function returns. Raises OSError if the processes belong to another user or have ended.
    """
    with _suspended(init):
        program = int((PROC / f"{init}/task/{init}/children").read_text().split()[0])
        descriptor = os.pidfd_open(program)
        try:
            signal.pidfd_send_signal(descriptor, signal.SIGTERM)
            if not select.select([descriptor], [], [], grace_s)[0]:
                signal.pidfd_send_signal(descriptor, signal.SIGKILL)
                return []
        finally:
            os.close(descriptor)
        deadline = time.monotonic() + GRACE_S
        while (names := sorted(_others(init))) and time.monotonic() < deadline:
            time.sleep(RETRY_S)
        return names


@contextmanager
def _suspended(pid: int) -> Iterator[None]:
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def _others(init: int) -> Iterator[str]:
    """Yield the names of all running processes of a container except its first process."""
    container = (PROC / f"{init}/ns/pid").stat().st_ino
    for entry in PROC.iterdir():
        with suppress(OSError):
            if entry.name.isdecimal() and int(entry.name) != init and (entry / "ns/pid").stat().st_ino == container:
                name, _, rest = (entry / "stat").read_text(errors="replace").partition("(")[2].rpartition(")")
                if rest.split()[0] not in ("Z", "X"):  # ended
                    yield name
