"""What a run needs of the lab that its vehicles and agents live in, whatever they are made of.

`netem.lab.Lab` is one, where they are processes; `harness.play.containers._container_lab.ContainerLab` is another.
"""

from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from socket import socket
from types import TracebackType
from typing import Literal, Protocol, Self

from harness.archive.directory import RunDirectory
from harness.scenario import Scenario
from netem.conditions import NetworkConditions
from netem.engine import Applied
from netem.lab import Lab as NetworkLab

Role = Literal["agent", "vehicle"]


class Program(Protocol):
    """A program that was started in the lab. Raises NetemError if the lab fails."""

    @property
    def returncode(self) -> int | None:
        """None while it runs; then its exit status, or minus the signal that killed it (subprocess)."""

    @property
    def end(self) -> str:
        """How it ended, for people."""

    async def wait(self) -> int:
        """Wait for its end; what it said is in its files then."""

    async def send_signal(self, number: int) -> None:
        """Nothing happens if it has ended."""

    async def pause(self) -> None:
        """It stands still until `resume`."""

    async def resume(self) -> None: ...

    async def terminate(self, grace_s: float) -> int:
        """End it with SIGTERM, or after `grace_s` seconds with SIGKILL; returns its return code."""


class MissionLab(Protocol):
    """Raises NetemError wherever it fails; as netem.lab.Lab does, and says, what is not said here."""

    @property
    def addresses(self) -> Mapping[int, str]: ...

    @property
    def broadcast(self) -> str: ...

    @property
    def engine(self) -> str: ...

    @property
    def network(self) -> NetworkLab:
        """The lab of `netem` with the switch, for programs that watch it: those are always processes."""

    async def spawn(
        self,
        vehicle: int,
        argv: Sequence[str],
        *,
        cwd: Path,
        env: Mapping[str, str],
        stdout: Path,
        stderr: Path,
        role: Role,
    ) -> Program: ...

    async def connect(self, vehicle: int, port: int, *, timeout_s: float) -> socket: ...

    async def apply(self, conditions: NetworkConditions) -> Applied: ...

    async def read(self) -> Applied: ...

    async def watch(self) -> None:
        """Raises when the lab has failed by itself."""

    async def close(self) -> None:
        """End everything in it, and remove it; may be called again, and raises nothing then."""

    async def __aenter__(self) -> Self: ...

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """As `close`, but raises nothing."""


OpenLab = Callable[[Scenario, RunDirectory, Callable[[str], None]], Awaitable[MissionLab]]
"""Brings up the lab of a run, saying what it does if that takes long. Raises NetemError or HarnessError."""
