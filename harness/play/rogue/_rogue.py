"""What the rogue node sends: the injections of a timeline, made from what it has heard.

It does no I/O, as `ucp.agent`: it is driven by `hears`, `begin` and `handle_timer`, and answers with `to_send`. Times
are mission seconds. Equal inputs and seed give equal outputs.

It follows the swarm's chain from the outside: a Block Add Request names the chain hash that its sender's chain ends in,
and a Commit Block the one that it ends in then. A block forged on top of the last of these meets the conditions of
Algorithm 6 wherever an agent has heard the same: the thesis leaves signatures to the platform (Section 3.3).
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from random import Random
from typing import TYPE_CHECKING, Any

from harness.play.rogue import _crafted
from harness.play.rogue.lies import Overheard, UnheardError
from harness.play.rogue.rogue_line import forged_sequence, line_of
from harness.scenario.injection import Corrupt, DelayedCopy, Duplicate, Flood, Forge, Injection, Lie, Replay
from ucp.block import HASH_BYTES, next_chain_hash
from ucp.clock import MICROSECONDS
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    MalformedDatagramError,
    Message,
    NextInSequenceResponse,
    decode,
)
from ucp.secure.envelope import NAMES, REQUEST_OF, read_clear
from ucp.secure.envelope import VERSION as SECURED

if TYPE_CHECKING:
    from harness.play.rogue._captured_bundle import CapturedKeys
    from ucp.secure.sealed_datagrams import Request

REMEMBERED = 10_000
"""Datagrams that it keeps to replay."""
MAX_WAITING = 100_000
"""Copies that wait to be sent; more are not made."""
FLOODED_AT_ONCE = 64
"""Messages of a flood between two looks at anything else."""


QUESTIONS = {NAMES[answer]: NAMES[question] for answer, question in REQUEST_OF.items()}
"""Type of an answer -> type of the question, by their names."""


@dataclass(frozen=True, slots=True)
class RogueDatagram:
    """One datagram of the rogue: `what` it is, of the injection with this number, under the address of `source`."""

    injection: int
    what: str
    source: int
    datagram: bytes
    plain: bytes | None = None
    """What it says in plain, if it is sealed and the rogue made it."""
    receivers: Sequence[int] | None = None
    """Who alone hears it; None: everybody."""

    def to_json(self, at_s: float) -> dict[str, Any]:
        said = self.plain or self.datagram
        return line_of(at_s, self.injection, self.what, self.source, said) | {"bytes": len(self.datagram)}


@dataclass(frozen=True, slots=True)
class _Heard:
    """A datagram of an agent; `message` is None if it is sealed, and `request` how an answer to it names it."""

    sender: int
    name: str
    message: Message | None
    request: "Request | None"
    datagram: bytes


@dataclass(slots=True)
class _Window:
    """An injection that goes on until `until`; a flood sends next at `next_at`."""

    number: int
    injection: Injection
    until: float
    next_at: float


class Rogue:
    """`epoch_us` is mission second 0 on the agents' clocks, in microseconds; `captured` are a vehicle's keys.

    It tells lies about chains if it knows `initial_data`, that of the mission.
    """

    def __init__(
        self,
        roster: Sequence[int],
        seed: int,
        epoch_us: int = 0,
        captured: "CapturedKeys | None" = None,
        initial_data: bytes = b"",
    ) -> None:
        self.sent: Counter[int] = Counter()
        """How many datagrams each injection that has begun has made."""
        self._roster = tuple(roster)
        self._rng = Random(f"{seed}/rogue")
        self._epoch_us = epoch_us
        self._captured = captured
        self._secured = captured is not None
        """Whether the mission is, by what is on the air, or as it has its keys."""
        self._heard: deque[tuple[int, str, bytes]] = deque(maxlen=REMEMBERED)
        self._top_chain_hash: bytes | None = None
        self._votes_name_chain = False
        self._overheard = Overheard(initial_data, epoch_us)
        self._asked: dict[tuple[int, str], Request] = {}
        """By sender and type of a question, sealed ones: how an answer to the last names it."""
        self._windows: list[_Window] = []
        self._waiting: list[tuple[float, int, RogueDatagram]] = []
        self._outbox: list[RogueDatagram] = []
        self._made = 0

    def hears(self, datagram: bytes, now: float) -> None:
        """An agent has sent `datagram`. What is not a message of UCP tells a rogue nothing."""
        try:
            sender, name, message, request = self._understood(datagram, now)
        except MalformedDatagramError:
            return
        self._heard.append((sender, name, datagram))
        if message is not None:
            self._overheard.hears(sender, message)
        if request is not None:
            self._asked[sender, name] = request
        if isinstance(message, BlockAddRequest | CommitBlock):
            self._top_chain_hash = message.chain_hash
        elif isinstance(message, BlockAddResponse):
            self._votes_name_chain = message.chain_hash is not None
        if self._windows:
            self._windows = [window for window in self._windows if window.until > now]
            for window in self._windows:
                self._react(window, _Heard(sender, name, message, request, datagram), now)

    def _understood(self, datagram: bytes, now: float) -> tuple[int, str, Message | None, "Request | None"]:
        """Sender and type; and what it says, and how it is answered, if it is in plain, or the rogue has keys.

        Raises MalformedDatagramError.
        """
        if datagram[2:3] != bytes([SECURED]):
            sender, _, message = decode(datagram)
            return sender, message.NAME, message, None
        clear = read_clear(datagram)
        self._secured = True
        opened = self._captured.opened(datagram, now) if self._captured else None
        return clear.sender, NAMES.get(clear.type, ""), *(opened or (None, None))

    def begin(self, number: int, injection: Injection, now: float) -> None:
        """The injection with this number, from 1, begins. Some end at once, some last."""
        self.sent[number] += 0
        if isinstance(injection, Replay):
            self._replay(number, injection)
        elif isinstance(injection, Forge) and injection.for_s is None:
            self._forge_commit(number, injection, now)
        elif isinstance(injection, Lie):
            self._lie(number, injection, now)
        else:
            self._windows.append(_Window(number, injection, now + injection.lasts_s, now))
            self.handle_timer(now)

    def next_timer(self) -> float | None:
        """When `handle_timer` has something to do next; None if it has not."""
        times = [window.next_at for window in self._windows if isinstance(window.injection, Flood)]
        return min([*times, *(at for at, _, _ in self._waiting[:1])], default=None)

    def handle_timer(self, now: float) -> None:
        """Send what is due by now."""
        while self._waiting and self._waiting[0][0] <= now:
            self._outbox.append(heappop(self._waiting)[2])
        for window in list(self._windows):
            if isinstance(window.injection, Flood):
                self._flood(window, window.injection, now)

    def to_send(self) -> list[RogueDatagram]:
        """What to send now, in order; empties the outbox."""
        outbox, self._outbox = self._outbox, []
        return outbox

    # What it makes of what it hears

    def _react(self, window: _Window, heard: "_Heard", now: float) -> None:
        injection, sender, datagram = window.injection, heard.sender, heard.datagram
        if isinstance(injection, Forge):
            answer = None if heard.message is None else self._answer(injection, heard.message)
            if sender != injection.sender and answer is not None:
                self._forge(window.number, "forge", injection.sender, answer, now, heard.request)
        elif isinstance(injection, Lie) or not injection.matches(heard.name, sender):
            return
        elif isinstance(injection, Duplicate):
            for _ in range(injection.copies):
                self._send(RogueDatagram(window.number, "duplicate", sender, datagram))
        elif isinstance(injection, Corrupt):
            changed = _crafted.corrupted(datagram, injection.bits, self._rng)
            self._send(RogueDatagram(window.number, "corrupt", sender, changed))
        elif (
            isinstance(injection, DelayedCopy)
            and now < window.until - injection.by_s
            and len(self._waiting) < MAX_WAITING
        ):
            self.sent[window.number] += 1
            self._made += 1
            copy = RogueDatagram(window.number, "delay", sender, datagram)
            heappush(self._waiting, (now + injection.by_s, self._made, copy))

    def _answer(self, forge: Forge, question: Message) -> Message | None:
        """What the forged answer to `question` is, if it is one to answer."""
        approve = bool(forge.approve)
        match question:
            case BlockAddRequest() if forge.message == BlockAddResponse.NAME:
                named = question.chain_hash if self._votes_name_chain else None
                return BlockAddResponse(question.block_hash, approve, named)
            case ChainContainQuery() if forge.message == ChainContainResponse.NAME:
                return ChainContainResponse(question.chain_hash, approve)
            case ChainHashSuccessorQuery() if forge.message == NextInSequenceResponse.NAME:
                return NextInSequenceResponse(question.chain_hash, None, 0)
        return None

    def _replay(self, number: int, replay: Replay) -> None:
        matching = ((sender, data) for sender, name, data in reversed(self._heard) if replay.matches(name, sender))
        last = [heard for heard, _ in zip(matching, range(replay.count), strict=False)]
        for sender, data in reversed(last):
            self._send(RogueDatagram(number, "replay", sender, data))

    def _lie(self, number: int, lie: Lie, now: float) -> None:
        try:
            message = self._overheard.message(lie)
        except UnheardError:
            return  # that nothing was sent is told in the end
        question = QUESTIONS.get(lie.message, "")
        asking = self._roster if lie.receivers is None else lie.receivers
        request = next((self._asked[agent, question] for agent in asking if (agent, question) in self._asked), None)
        self._forge(number, "lie", lie.sender, message, now, request, lie.receivers)

    def _forge_commit(self, number: int, forge: Forge, now: float) -> None:
        if self._secured and self._top_chain_hash is None:
            self._top_chain_hash = bytes(HASH_BYTES)  # what the chain ends in is sealed: it can but guess
        if self._top_chain_hash is None:
            return  # nobody has said yet what the chain ends in
        block = _crafted.forged_block(forge.sender, self._timestamp_us(now))
        self._top_chain_hash = next_chain_hash(self._top_chain_hash, block.block_hash)
        self._forge(number, "forge", forge.sender, _crafted.forged_commit(block, self._top_chain_hash), now)

    def _flood(self, window: _Window, flood: Flood, now: float) -> None:
        messages = round(flood.for_s * flood.per_s)
        for _ in range(FLOODED_AT_ONCE):
            if self.sent[window.number] == messages or now >= window.until:
                self._windows.remove(window)
                return
            if window.next_at > now:
                return
            content = _crafted.random_message(flood.message, self._roster, self._timestamp_us(now), self._rng)
            sender = self._rng.choice(self._roster) if flood.sender is None else flood.sender
            self._forge(window.number, "flood", sender, content, now)
            window.next_at = window.until - flood.for_s + self.sent[window.number] / flood.per_s

    def _forge(
        self,
        number: int,
        what: str,
        sender: int,
        message: Any,
        now: float,
        request: "Request | None" = None,
        receivers: Sequence[int] | None = None,
    ) -> None:
        sequence = forged_sequence(number, self.sent[number])
        plain = _crafted.datagram(sender, sequence, message)
        if not (self._secured and self._captured):
            self._send(RogueDatagram(number, what, sender, plain, receivers=receivers))
            return
        said = decode(plain).message
        sealed = self._captured.sealed(sender, sequence, said, request, now, self._timestamp_us(now))
        self._send(RogueDatagram(number, what, sender, sealed, plain, receivers))

    def _send(self, injected: RogueDatagram) -> None:
        self.sent[injected.injection] += 1
        self._outbox.append(injected)

    def _timestamp_us(self, now: float) -> int:
        return self._epoch_us + round(now * MICROSECONDS)
