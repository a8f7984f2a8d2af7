"""What a case works with: an agent of its own, what its peers say and hear, and what should have come."""

import asyncio
import base64
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from harness.conformance._reference_model import AGENT, EVENT_ID, INITIAL_DATA
from harness.conformance._state_space import VARIANTS
from harness.conformance._subject import NO_KEYS
from harness.conformance._udp_lab import AgentEndedError, Air, Ear, Process
from ucp.block import InceptionBlock
from ucp.clock import MICROSECONDS
from ucp.messages import ChainContainQuery, ChainContainResponse, MalformedDatagramError, Message, decode, encode

SPEEDUP = 20.0
PATIENCE_S = 3.0
"""So long a case waits for what must come, in wall time."""
CALM_S = 0.25
"""So long for what must not come."""
INCEPTION = InceptionBlock(INITIAL_DATA).chain_hash


Heard = TypeVar("Heard", bound=Message)


class WrongError(Exception):
    """The agent did otherwise: what was expected, and what came."""

    def __init__(self, expected: str, came: str) -> None:
        super().__init__(f"expected {expected}; {came}")
        self.expected, self.came = expected, came


class CannotTellError(Exception):
    """Nothing can be said of this agent here: why."""


@dataclass(frozen=True)
class ByHand:
    """A case. `section` is that of the thesis, or of the contract."""

    name: str
    algorithm: int
    section: str
    play: Callable[["Bench"], Awaitable[None]]


ALL: list[ByHand] = []


def case(name: str, section: str, algorithm: int = 0) -> Callable[[Callable[["Bench"], Awaitable[None]]], None]:
    """Declare a function to be a case; 0 is no Algorithm."""

    def declare(play: Callable[["Bench"], Awaitable[None]]) -> None:
        ALL.append(ByHand(name, algorithm, section, play))

    return declare


def must(true: bool, expected: str, came: object) -> None:
    """Raises WrongError."""
    if not true:
        raise WrongError(expected, f"came {came}")


class Alone:
    """An agent on the bench."""

    def __init__(self, process: Process, ear: Ear) -> None:
        self.process = process
        self.ear = ear
        self.agent_id = process.agent_id
        self.epoch_s = 0.0
        self._sequence = 0

    async def begin(self, ahead_s: float = 0.0) -> None:
        """The mission starts in so many wall seconds, or did so long ago."""
        self.epoch_s = time.time() + ahead_s
        await self.process.ask("start", epoch_us=round(self.epoch_s * MICROSECONDS))

    def mission_s(self) -> float:
        return (time.time() - self.epoch_s) * SPEEDUP

    def say(self, sender: int, message: Message) -> None:
        self._sequence += 1
        self.ear.say(encode(sender, self._sequence, message))

    async def log(self, data: bytes) -> None:
        await self.process.ask("log", event_id=EVENT_ID, data=base64.b64encode(data).decode("ascii"))

    async def hear(self, count: int, what: str, within_s: float = PATIENCE_S) -> list[Message]:
        """The next messages. Raises WrongError if there are fewer."""
        until = time.time() + within_s
        while len(self.ear.heard) < count and time.time() < until:
            self.ear.drain()
            await self.ear.arrival(min(until, time.time() + CALM_S))
        heard = [_message(data) for _, data in self.ear.heard[:count]]
        del self.ear.heard[:count]
        must(len(heard) == count, what, f"{len(heard)} messages: {_names(heard)}")
        return heard

    async def hear_one(self, kind: type[Heard], after: str) -> Heard:
        """Return the next message. Raises WrongError if there is none, or one of another type."""
        what = f"a {kind.NAME} after {after}"
        (heard,) = await self.hear(1, what)
        if not isinstance(heard, kind):
            raise WrongError(what, f"came {heard.NAME}")
        return heard

    async def hear_nothing(self, why: str, for_s: float = CALM_S) -> None:
        await asyncio.sleep(for_s)
        heard = [_message(data) for _, data in self.ear.take()]
        must(not heard, f"nothing {why}", _names(heard))

    async def answers_only(self, top: bytes, after: str) -> None:
        """Asked whether it has this chain it says yes, and has said nothing else since."""
        self.say(2 if self.agent_id != 2 else 3, ChainContainQuery(top))
        (heard,) = await self.hear(1, f"an answer to a Chain Contain Query after {after}")
        right = ChainContainResponse(top, True)
        must(heard == right, f"nothing but the answer to a Chain Contain Query after {after}", heard.NAME)

    async def status(self) -> dict[str, Any]:
        return await self.process.ask("status")

    async def end(self) -> int:
        """How it ended by itself. Raises WrongError if it did not."""
        try:
            return await asyncio.wait_for(self.process.process.wait(), PATIENCE_S * 2)
        except TimeoutError:
            raise WrongError("the agent ends", "it runs on") from None


class Bench:
    """Where a case puts its agents."""

    def __init__(self, air: Air) -> None:
        self.air = air

    @asynccontextmanager
    async def agent(
        self,
        keys: Mapping[str, Any] = NO_KEYS,
        *,
        started: bool = True,
        prepare: Callable[[Path], None] | None = None,
        directory: Path | None = None,
        port: int | None = None,
    ) -> AsyncIterator[Alone]:
        """An agent that is ready, and whose mission has begun if not told otherwise; `keys` are of its mission."""
        async with self.program(keys, prepare=prepare, directory=directory, port=port) as alone:
            await alone.process.ready()
            if started:
                await alone.begin()
            try:
                yield alone
            except WrongError:
                if not alone.process.signalled and alone.process.process.returncode is None:
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
    ) -> AsyncIterator[Alone]:
        """An agent that may never be ready. `text` is all of its mission file.

        `prepare` is given its directory, or `directory` is that of an earlier life.
        """
        taken = self.air.take_port() if port is None else port
        try:
            document = self.air.mission(VARIANTS["default"], taken, SPEEDUP, keys)
            where = directory or self.air.new_directory()
            if prepare is not None:
                prepare(where)
            agent_id = int(keys.get("agent_id", AGENT))
            ear = Ear(self.air, taken)
            try:
                process = await Process.start(self.air, where, document if text is None else text, agent_id)
                try:
                    yield Alone(process, ear)
                finally:
                    await process.kill()
            finally:
                ear.close()
        finally:
            if port is None:
                self.air.give_back(taken)


def _message(data: bytes) -> Message:
    try:
        return decode(data).message
    except MalformedDatagramError as error:
        raise WrongError("well-formed messages", f"{len(data)} bytes: {error.reason}") from None


def _names(messages: Sequence[Message]) -> str:
    return ", ".join(message.NAME for message in messages) or "nothing"


__all__ = ["ALL", "AgentEndedError", "Alone", "Bench", "ByHand", "CannotTellError", "WrongError", "case", "must"]
