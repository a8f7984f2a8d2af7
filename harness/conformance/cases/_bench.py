"""Provide the tools for a handwritten test case: start agents, simulate their peers, and check messages."""

import asyncio
import base64
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from harness.conformance._agent_under_test import NO_KEYS
from harness.conformance._reference_model import AGENT, EVENT_ID, INITIAL_DATA
from harness.conformance._state_space import VARIANTS
from harness.conformance._udp_lab import AgentEndedError, PeerSocket, ProcessUnderTest, UdpLab
from ucp.block import InceptionBlock
from ucp.clock import MICROSECONDS
from ucp.messages import ChainContainQuery, ChainContainResponse, MalformedDatagramError, Message, decode, encode

SPEEDUP = 20.0
PATIENCE_S = 3.0
"""Time limit for an expected message, in seconds of wall time."""
SILENCE_S = 0.25
"""Seconds of wall time without a message after which an agent counts as silent."""
INCEPTION = InceptionBlock(INITIAL_DATA).chain_hash


ReceivedMessage = TypeVar("ReceivedMessage", bound=Message)


class WrongBehaviourError(Exception):
    """An error: the agent did not behave as expected. `expected` and `received` describe the difference."""

    def __init__(self, expected: str, received: str) -> None:
        super().__init__(f"expected {expected}; {received}")
        self.expected, self.received = expected, received


class CannotJudgeError(Exception):
    """An error: the test case cannot judge this agent on this machine. The message is the reason."""


@dataclass(frozen=True)
class HandwrittenCase:
    """A handwritten test case."""

    name: str
    algorithm: int
    """Number of the Algorithm under test. 0 if the case tests no single Algorithm."""
    section: str
    """Section of the thesis or of the agent contract that the case tests."""
    play: Callable[["CaseBench"], Awaitable[None]]
    """The function that runs the case. The function raises WrongBehaviourError if the case fails."""


ALL_CASES: list[HandwrittenCase] = []


def case(name: str, section: str, algorithm: int = 0) -> Callable[[Callable[["CaseBench"], Awaitable[None]]], None]:
    """Return a decorator that adds a test case to `ALL_CASES`. Algorithm 0 means that the case tests no single
    Algorithm.
    """

    def declare(play: Callable[["CaseBench"], Awaitable[None]]) -> None:
        ALL_CASES.append(HandwrittenCase(name, algorithm, section, play))

    return declare


def require(true: bool, expected: str, received: object) -> None:
    """Raise WrongBehaviourError if the condition is false."""
    if not true:
        raise WrongBehaviourError(expected, f"came {received}")


class BenchAgent:
    """An agent in a handwritten test case, and the other agents, which the harness simulates."""

    def __init__(self, process: ProcessUnderTest, peer_socket: PeerSocket) -> None:
        self.process = process
        self.peer_socket = peer_socket
        self.agent_id = process.agent_id
        self.epoch_s = 0.0
        self.epoch_us = 0
        """Start of the mission in microseconds, on the clock of the agent's computer."""
        self._sequence = 0

    async def begin(self, ahead_s: float = 0.0) -> None:
        """Start the mission in `ahead_s` seconds of wall time. A negative value sets the start in the past."""
        self.epoch_s = time.time() + ahead_s
        self.epoch_us = await self.process.start_mission(round(self.epoch_s * MICROSECONDS))

    def mission_s(self) -> float:
        return (time.time() - self.epoch_s) * SPEEDUP

    def send(self, sender: int, message: Message) -> None:
        self._sequence += 1
        self.peer_socket.send(encode(sender, self._sequence, message))

    async def log(self, data: bytes) -> None:
        await self.process.ask("log", event_id=EVENT_ID, data=base64.b64encode(data).decode("ascii"))

    async def receive(self, count: int, what: str, within_s: float = PATIENCE_S) -> list[Message]:
        """Return the next `count` messages. Raises WrongBehaviourError if fewer arrive within the time limit."""
        until = time.time() + within_s
        while len(self.peer_socket.received) < count and time.time() < until:
            self.peer_socket.drain()
            await self.peer_socket.arrival(min(until, time.time() + SILENCE_S))
        received = [_message(data) for _, data in self.peer_socket.received[:count]]
        del self.peer_socket.received[:count]
        require(len(received) == count, what, f"{len(received)} messages: {_names(received)}")
        return received

    async def receive_one(self, kind: type[ReceivedMessage], after: str) -> ReceivedMessage:
        """Return the next message. Raises WrongBehaviourError if no message arrives, or if the message has a different
        type.
        """
        what = f"a {kind.NAME} after {after}"
        (received,) = await self.receive(1, what)
        if not isinstance(received, kind):
            raise WrongBehaviourError(what, f"came {received.NAME}")
        return received

    async def receive_nothing(self, why: str, for_s: float = SILENCE_S) -> None:
        await asyncio.sleep(for_s)
        received = [_message(data) for _, data in self.peer_socket.take()]
        require(not received, f"nothing {why}", _names(received))

    async def require_single_answer(self, top: bytes, after: str) -> None:
        """Ask the agent whether its chain contains this chain hash. The next message of the agent must be the answer
        yes. Any other message raises WrongBehaviourError, so a late answer to an earlier message also raises this
        error.
        """
        self.send(2 if self.agent_id != 2 else 3, ChainContainQuery(top))
        (received,) = await self.receive(1, f"an answer to a Chain Contain Query after {after}")
        right = ChainContainResponse(top, True)
        require(received == right, f"nothing but the answer to a Chain Contain Query after {after}", received.NAME)

    async def status(self) -> dict[str, Any]:
        return await self.process.ask("status")

    async def end(self) -> int:
        """Wait until the process ends, and return its exit status. Raises WrongBehaviourError if it does not end."""
        try:
            return await asyncio.wait_for(self.process.program.process.wait(), PATIENCE_S * 2)
        except TimeoutError:
            raise WrongBehaviourError("the agent ends", "it still runs") from None


class CaseBench:
    """The tools with which a handwritten test case starts agents in the virtual network."""

    def __init__(self, lab: UdpLab) -> None:
        self.lab = lab

    def require_own_machine(self, what: str) -> None:
        """Raise CannotJudgeError if the agent runs on another computer. `what` names the data that are visible only on
        that computer.
        """
        if self.lab.remote is not None:
            raise CannotJudgeError(f"{what} of an agent on another computer cannot be seen from here")

    def require_large_machine(self, what: str) -> None:
        """Raise CannotJudgeError if the profile for small machines applies. `what` names the feature that an agent with
        this profile may lack.
        """
        if self.lab.small:
            raise CannotJudgeError(f"an agent on a small machine may leave out {what}")

    @asynccontextmanager
    async def agent(
        self,
        keys: Mapping[str, Any] = NO_KEYS,
        *,
        started: bool = True,
        prepare: Callable[[Path], None] | None = None,
        directory: Path | None = None,
        port: int | None = None,
    ) -> AsyncIterator[BenchAgent]:
        """Start an agent and wait until it is ready. If `started` is true, also start its mission. `keys` contains keys
        with other values than in the usual mission file. The other arguments are passed to `program`.
        """
        async with self.program(keys, prepare=prepare, directory=directory, port=port) as alone:
            await alone.process.ready()
            if started:
                await alone.begin()
            try:
                yield alone
            except WrongBehaviourError:
                if not alone.process.signalled and alone.process.program.process.returncode is None:
                    await alone.process.check_answers()
                raise

    @asynccontextmanager
    async def program(
        self,
        keys: Mapping[str, Any] = NO_KEYS,
        *,
        text: bytes | None = None,
        prepare: Callable[[Path], None] | None = None,
        directory: Path | None = None,
        port: int | None = None,
    ) -> AsyncIterator[BenchAgent]:
        """Start an agent that may never become ready.

        `text` replaces the whole mission file. `prepare` receives the directory of the agent before its start. For a
        restart, `directory` and `port` are those of the earlier incarnation.
        """
        taken = self.lab.take_port() if port is None else port
        try:
            document = self.lab.mission(VARIANTS["default"], taken, SPEEDUP, keys)
            where = directory or self.lab.new_directory()
            if prepare is not None:
                prepare(where)
            agent_id = int(keys.get("agent_id", AGENT))
            peer_socket = PeerSocket(self.lab, taken)
            try:
                process = await ProcessUnderTest.start(
                    self.lab, where, document if text is None else text, agent_id, taken, SPEEDUP
                )
                try:
                    yield BenchAgent(process, peer_socket)
                finally:
                    await process.program.kill()
            finally:
                peer_socket.close()
        finally:
            if port is None:
                self.lab.return_port(taken)


def _message(data: bytes) -> Message:
    try:
        return decode(data).message
    except MalformedDatagramError as error:
        raise WrongBehaviourError("well-formed messages", f"{len(data)} bytes: {error.reason}") from None


def _names(messages: Sequence[Message]) -> str:
    return ", ".join(message.NAME for message in messages) or "nothing"


__all__ = [
    "ALL_CASES",
    "AgentEndedError",
    "BenchAgent",
    "CannotJudgeError",
    "CaseBench",
    "HandwrittenCase",
    "WrongBehaviourError",
    "case",
    "require",
]
