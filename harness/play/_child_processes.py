"""Find and end processes that an agent started and left behind.

The harness puts a random mark into the environment of each agent, and a child inherits the environment. If a process
with the mark still runs after its agent has ended, the agent left it behind, and the harness ends it. The mark also
identifies children that left the session of the agent. A child that cleared its environment is not found. Such a child
ends together with the lab.

In a container, the kernel ends the children. `harness.play.containers._container_processes` finds the names of these
children.
"""

import os
import secrets
import signal
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

NAME = "UCP_HARNESS_AGENT"
GRACE_S = 0.5
"""Seconds of wall time for which the harness waits after the end of an agent, so that the agent's child processes can
end by themselves.
"""
RETRY_S = 0.02
MAX_ROUNDS = 20
"""Maximum number of rounds in which the harness ends child processes. Several rounds are needed if a child process
starts further processes.
"""
_PASSED_ON = {
    *("PATH", "HOME", "USER", "LOGNAME", "SHELL", "TERM", "TMPDIR", "TZ", "LANG", "LANGUAGE", "VIRTUAL_ENV"),
    *("CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH"),
}
_PASSED_ON_PREFIXES = ("LC_", "LD_", "PYTHON", "UCP_", "XDG_", "ROS_", "RMW_", "AMENT_", "CYCLONEDDS_", "FASTRTPS_")


def passed_on(environ: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables that the harness passes to the programs of a run.

    The programs need these variables to start. The harness passes no other variables, because the user's environment
    may contain secrets, such as tokens, and an agent may be a program of another author.
    """
    return {
        name: value for name, value in environ.items() if name in _PASSED_ON or name.startswith(_PASSED_ON_PREFIXES)
    }


class ChildProcesses:
    """The process of one agent and all processes that it started."""

    def __init__(self) -> None:
        self._mark = f"{NAME}={secrets.token_hex(16)}".encode()

    def environment(self, inherited: Mapping[str, str]) -> dict[str, str]:
        """Return the environment variables with which the agent must be started. The variables identify the agent's
        child processes.
        """
        name, _, value = self._mark.decode().partition("=")
        return {**passed_on(inherited), name: value}

    def pids(self) -> list[int]:
        """Return the IDs of the agent's processes that still run."""
        return [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit() and self._has_mark(entry)]

    def _has_mark(self, entry: Path) -> bool:
        try:
            return self._mark in (entry / "environ").read_bytes().split(b"\0")
        except OSError:  # the process has ended, or belongs to another user
            return False

    def end_left_behind(self) -> list[str]:
        """End the processes that still run after the end of the agent. Return their names."""
        deadline = time.monotonic() + GRACE_S
        while (left := self.pids()) and time.monotonic() < deadline:
            time.sleep(RETRY_S)
        names = sorted(filter(None, map(_name, left)))
        self.end()
        return names

    def end(self) -> None:
        """Kill all processes of the agent."""
        for _ in range(MAX_ROUNDS):
            pids = self.pids()
            for pid in pids:
                self._kill(pid)
            if not pids:
                return

    def _kill(self, pid: int) -> None:
        """Kill the process, unless the kernel has given its ID to a different process."""
        with suppress(OSError):
            descriptor = os.pidfd_open(pid)
            try:
                if self._has_mark(Path("/proc") / str(pid)):
                    signal.pidfd_send_signal(descriptor, signal.SIGKILL)
            finally:
                os.close(descriptor)


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
