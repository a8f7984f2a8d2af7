"""Define the interface of a program that runs in a virtual network, as a process, in a container or elsewhere."""

from collections.abc import Sequence
from typing import Protocol


class LabProgram(Protocol):
    """A program that runs in the virtual network. Its methods raise NetemError if the network fails."""

    @property
    def returncode(self) -> int | None:
        """The exit status, or the negative number of the signal that killed the program. The value is None while the
        program runs.
        """

    @property
    def end(self) -> str:
        """A phrase for the user that describes how the program ended."""

    @property
    def left_behind(self) -> Sequence[str]:
        """The names of the processes that the program left behind, and that `terminate` ended together with the
        program's container. If the program runs without a container, such processes continue, and the list is empty.
        """

    async def wait(self) -> int:
        """Wait for the program to end and for all its output to be in its files. Return `returncode`."""

    async def send_signal(self, number: int) -> None:
        """Send a signal to the program. Do nothing if the program has ended."""

    async def pause(self) -> None:
        """Suspend the program until `resume`."""

    async def resume(self) -> None: ...

    async def terminate(self, grace_s: float) -> int:
        """End the program with SIGTERM, and after `grace_s` seconds with SIGKILL. Return `returncode`."""
