"""The interface of a virtual network in which the vehicles and agents of a mission run. `netem.lab.Lab` implements it
with processes, and `harness.play.containers._container_lab.ContainerLab` with containers.
"""

from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from socket import socket
from types import TracebackType
from typing import Literal, Protocol, Self

from harness.archive.directory import RunDirectory
from harness.play.process.lab_program import LabProgram
from harness.scenario import Scenario
from netem.conditions import NetworkConditions
from netem.engine import AppliedConditions
from netem.lab import Lab as NetworkLab

Role = Literal["agent", "vehicle"]


class VehicleLab(Protocol):
    """A lab or cluster that runs vehicle programs. Its methods raise NetemError if a program cannot be started.

    `netem.lab.Lab` documents the methods.
    """

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
        max_file_bytes: int | None = None,
    ) -> LabProgram: ...

    async def connect(self, vehicle: int, port: int, *, timeout_s: float) -> socket: ...


class MissionLab(VehicleLab, Protocol):
    """A virtual network with vehicles and agents. Its methods raise NetemError if the network fails.

    `netem.lab.Lab` documents the methods that have no docstring here.
    """

    @property
    def addresses(self) -> Mapping[int, str]: ...

    @property
    def broadcast(self) -> str: ...

    @property
    def engine(self) -> str: ...

    @property
    def network(self) -> NetworkLab:
        """The underlying network of `netem`. The harness runs its own programs in this network, such as packet
        captures.
        """

    async def apply(self, conditions: NetworkConditions) -> AppliedConditions: ...

    async def read(self) -> AppliedConditions: ...

    async def watch(self) -> None:
        """Wait until the network fails, then raise NetemError."""

    async def close(self) -> None:
        """End all programs, and remove the network. A second call does nothing."""

    async def __aenter__(self) -> Self: ...

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the network, and ignore errors."""


OpenLab = Callable[[Scenario, RunDirectory, Callable[[str], None]], Awaitable[MissionLab]]
"""A function that opens the lab of a run. The last argument is a function that reports slow steps to the user.

Raises NetemError or HarnessError.
"""
