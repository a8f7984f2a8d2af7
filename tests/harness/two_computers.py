"""Imitate two computers for tests. Each computer is a network namespace, and a veth pair connects both.

The lab's computer has the address 192.168.7.1, and the far one 192.168.7.2. `cut`, `reset` and `lose` disturb the cable
between them with nftables.
"""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest

from tests.harness.command import COMMAND, DEADLINE_S

LAB, FAR = "192.168.7.1", "192.168.7.2"
PORT = 14700
LISTEN = f"{LAB}:{PORT}"
OUR_AGENT = (sys.executable, "-P", "-m", "ucp.node")

needs_two_computers = [
    pytest.mark.skipif(not os.access("/dev/net/tun", os.W_OK), reason="this user may not open /dev/net/tun"),
    pytest.mark.skipif(os.geteuid() != 0, reason="only root can make two computers"),
    pytest.mark.skipif(shutil.which("nft") is None, reason="nftables is not installed"),
]


class TwoComputers:
    """Two network namespaces in place of computers, and the programs that a test started in them."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._holders = [subprocess.Popen(["unshare", "--net", "sleep", "600"]) for _ in range(2)]
        self._started: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Self:
        own = Path("/proc/self/ns/net").readlink()
        for holder in self._holders:
            wait_until(lambda holder=holder: Path(f"/proc/{holder.pid}/ns/net").readlink() != own, "a namespace")
        self.on("lab", "ip", "link", "add", "eth0", "type", "veth", "peer", "eth0", "netns", str(self._holders[1].pid))
        for computer, address in (("lab", LAB), ("far", FAR)):
            self.on(computer, "ip", "address", "add", f"{address}/24", "dev", "eth0")
            for link in ("lo", "eth0"):
                self.on(computer, "ip", "link", "set", link, "up")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._started:
            process.kill()
            process.wait()
            assert process.stdout is not None
            process.stdout.close()
        for holder in self._holders:
            holder.kill()
            holder.wait()

    def _inside(self, computer: str) -> list[str]:
        return ["nsenter", f"--net=/proc/{self._holders[computer == 'far'].pid}/ns/net"]

    def on(self, computer: str, *argv: str) -> str:
        """Run a program on a computer, and return its output."""
        done = subprocess.run([*self._inside(computer), *argv], capture_output=True, text=True, check=True)
        return done.stdout

    def start(self, computer: str, *arguments: object, **settings: Any) -> subprocess.Popen[str]:
        """Start `ucp-harness` on a computer."""
        return self.run(computer, *COMMAND, *map(str, arguments), **settings)

    def run(self, computer: str, *argv: str, **settings: Any) -> subprocess.Popen[str]:
        """Start a program on a computer."""
        process = subprocess.Popen(
            [*self._inside(computer), *argv],
            cwd=self.directory,
            env={**os.environ, "TMPDIR": str(self.directory)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            **settings,
        )
        self._started.append(process)
        return process

    def join(
        self, *options: object, agent: int = 2, key: str = "lab.key", command: Sequence[object] = OUR_AGENT
    ) -> subprocess.Popen[str]:
        """Start the command with which the far computer joins the harness with an agent."""
        words = ["join", LISTEN, "--as", agent, "--secret-file", key, *options]
        return self.start("far", *words, "--", *command)

    def cut(self) -> None:
        """Let the cable lose all packets."""
        self._spoil("drop")

    def reset(self) -> None:
        """Break all connections between the computers, and let all new connections fail."""
        self._spoil("tcp flags & (syn | rst) == 0 reject with tcp reset")

    def lose(self, percent: int) -> None:
        """Let the cable lose this percentage of the packets in each direction."""
        self._spoil(f"numgen random mod 100 < {percent} drop")

    def _spoil(self, rule: str) -> None:
        table = f"table ip cable {{ chain c {{ type filter hook input priority 0; {rule}; }}; }}"
        for computer in ("lab", "far"):
            self.on(computer, "nft", table)

    def mend(self) -> None:
        for computer in ("lab", "far"):
            self.on(computer, "nft", "delete table ip cable")


def wait_until(condition: Any, what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"never: {what}"
        time.sleep(0.02)
