"""Run the agents of a conformance test on another computer.

A conformance test starts many incarnations of one agent, and several of them run at the same time. The far end keeps
one connection ready for each of these incarnations. A stand-in uses any of the ready connections, and the far end then
opens a new one.

A lost connection ends the test, because the inputs of the agent during the gap are unknown.
"""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness.errors import MachineError
from harness.play.process.lab_program import LabProgram
from harness.play.remote._far_ends import JOIN_LIMIT_S, SOCKET, FarEnd, FarEnds, listening
from harness.play.remote._remote_program import RemoteProgram
from harness.play.remote._stand_in_task import StandInTask

PLACES = 12
"""Maximum number of incarnations that run at the same time. The number is small, because a far computer may have less
memory and fewer cores than the computer of the harness.
"""
WAIT_LIMIT_S = 10.0
"""Maximum time that a stand-in waits for a connection, in seconds of wall time. After this time, the far end counts as
ended.
"""
MAX_DELAY_S = 0.02
"""Maximum delay of the connection in one direction, in seconds of wall time. With a longer delay, answers would come
too late for timers of a test, some of which expire after 0.2 s.
"""


@dataclass
class AgentPool:
    """The agents of a conformance test that run on another computer. Use the context manager `opened`."""

    agent_id: int
    listen: str
    """The address ADDRESS:PORT to which the far end connects."""
    secret: bytes
    host: str = ""
    command: list[str] = field(default_factory=list)
    delay_s: float = 0.0
    _directory: Path = Path()
    _session: str = ""
    _held: deque[FarEnd] = field(default_factory=deque)
    _waiting: deque[socket.socket] = field(default_factory=deque)
    """The stand-ins that are waiting for a connection."""
    _incarnations: list[RemoteIncarnation] = field(default_factory=list)
    is_encrypted: bool = False
    """True if the connection to the far end is encrypted, so that it can carry keys."""
    _joined: asyncio.Event = field(default_factory=asyncio.Event)
    _lost: asyncio.Event = field(default_factory=asyncio.Event)

    @asynccontextmanager
    async def opened(self, directory: Path) -> AsyncIterator[None]:
        """Listen inside this context. Raises MachineError if the address cannot be used."""
        self._directory = directory
        far_ends = FarEnds(self, "a conformance test", places=PLACES)
        async with far_ends.opened([listening(self.listen)], self.secret, directory):
            try:
                yield
            finally:
                for far_end in self._held:
                    far_end.connection.close()

    async def wait(self) -> None:
        """Wait until the far end has joined. Raises MachineError if it does not join, or if its connection is
        too slow.
        """
        try:
            await asyncio.wait_for(self._joined.wait(), JOIN_LIMIT_S)
        except TimeoutError:
            raise MachineError(
                f"agent {self.agent_id} did not join within {JOIN_LIMIT_S:g} s: type the command above on its computer"
            ) from None
        if self.delay_s > MAX_DELAY_S:
            raise MachineError(
                f"the connection to {self.host} takes {1000 * self.delay_s:.3g} ms in one direction, but a conformance "
                f"test needs at most {1000 * MAX_DELAY_S:g} ms: use a faster connection"
            )

    async def watch(self) -> None:
        """Wait until a connection is lost, then raise MachineError."""
        await self._lost.wait()
        raise MachineError(
            f"the connection to the computer {self.host} was lost, so the test has no result: start both commands again"
        )

    def add(self, incarnation: RemoteIncarnation) -> int:
        """Add an incarnation, and return its number."""
        self._incarnations.append(incarnation)
        return len(self._incarnations) - 1

    @property
    def socket_path(self) -> Path:
        """The path of the socket to which stand-ins connect."""
        return self._directory / SOCKET

    # The methods of harness.play.remote._far_ends.Host

    def refusal(self, agent_id: int, session: str, host: str) -> str:
        if agent_id != self.agent_id:
            return f"this conformance test tests agent {self.agent_id}, not agent {agent_id}: use --as {self.agent_id}"
        if self._session not in ("", session):
            return f"agent {agent_id} has joined from {self.host} already: end that one"
        return ""

    async def receive(self, far_end: FarEnd) -> None:
        self._session, self.host, self.command = far_end.session, far_end.host, far_end.command
        if not self._joined.is_set():
            self.is_encrypted = far_end.channel.is_encrypted
            self.delay_s = await far_end.measured_delay()
            self._joined.set()
        await far_end.keep()
        self._held.append(far_end)
        self._match()

    def begin(self, number: int, stand_in: socket.socket) -> None:
        self._waiting.append(stand_in)
        self._match()
        asyncio.get_running_loop().call_later(WAIT_LIMIT_S, self._check, stand_in)

    def _check(self, stand_in: socket.socket) -> None:
        if stand_in in self._waiting:
            self._lost.set()

    def hear(self, number: int, stand_in: socket.socket, message: dict[str, Any]) -> None:
        incarnation = self._incarnations[number]
        incarnation.epoch_us = message.get("epoch_us", incarnation.epoch_us)
        incarnation.left_behind = tuple(message.get("left_behind", incarnation.left_behind))
        if message.get("cut_off"):
            self._lost.set()
        if message.get("waits"):
            self._waiting.appendleft(stand_in)
            self._match()
        if not message and stand_in in self._waiting:
            self._waiting.remove(stand_in)

    def _match(self) -> None:
        while self._held and self._waiting:
            far_end = self._held.popleft()
            if far_end.is_connected:
                far_end.hand_over(self._waiting.popleft(), None)
            else:
                far_end.connection.close()


class RemoteIncarnation:
    """One incarnation of an agent on another computer."""

    def __init__(self, pool: AgentPool, agent_id: int, vehicle: int, port: int, speedup: float) -> None:
        task = StandInTask(pool.add(self), agent_id, vehicle, port, speedup, measures_lag=False)
        self.stand_in_command = task.command(pool.socket_path)
        """The command of the stand-in, the local process that represents the remote agent. The caller appends the
        mission file.
        """
        self.epoch_us = 0
        """The start of the mission on the far clock, in microseconds since the Unix epoch."""
        self.left_behind: tuple[str, ...] = ()

    def controlled(self, stand_in: LabProgram) -> LabProgram:
        """Return the program that the test controls. This program represents the stand-in."""
        return RemoteProgram(stand_in, lambda: self.left_behind)
