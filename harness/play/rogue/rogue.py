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
from typing import Any

from harness.play.rogue import crafted
from harness.play.rogue.line import line_of
from harness.play.rogue.sequences import forged_sequence
from harness.scenario.injection import Corrupt, DelayedCopy, Duplicate, Flood, Forge, Injection, Replay
from ucp.block import next_chain_hash
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

REMEMBERED = 10_000
"""Datagrams that it keeps to replay."""
MAX_WAITING = 100_000
"""Copies that wait to be sent; more are not made."""
FLOODED_AT_ONCE = 64
"""Messages of a flood between two looks at anything else."""


@dataclass(frozen=True, slots=True)
class RogueDatagram:
    """One datagram of the rogue: `what` it is, of the injection with this number, under the address of `source`."""

    injection: int
    what: str
    source: int
    datagram: bytes

    def to_json(self, at_s: float) -> dict[str, Any]:
        return line_of(at_s, self.injection, self.what, self.source, self.datagram)


@dataclass(slots=True)
class _Window:
    """An injection that goes on until `until`; a flood sends next at `next_at`."""

    number: int
    injection: Injection
    until: float
    next_at: float


class Rogue:
    """`epoch_us` is mission second 0 on the agents' clocks, in microseconds."""

    def __init__(self, roster: Sequence[int], seed: int, epoch_us: int = 0) -> None:
        self.sent: Counter[int] = Counter()
        """How many datagrams each injection that has begun has made."""
        self._roster = tuple(roster)
        self._rng = Random(f"{seed}/rogue")
        self._epoch_us = epoch_us
        self._heard: deque[tuple[int, str, bytes]] = deque(maxlen=REMEMBERED)
        self._top_chain_hash: bytes | None = None
        self._votes_name_chain = False
        self._windows: list[_Window] = []
        self._waiting: list[tuple[float, int, RogueDatagram]] = []
        self._outbox: list[RogueDatagram] = []
        self._made = 0

    def hears(self, datagram: bytes, now: float) -> None:
        """An agent has sent `datagram`. What is not a message of UCP tells a rogue nothing."""
        try:
            sender, _, message = decode(datagram)
        except MalformedDatagramError:
            return
        self._heard.append((sender, message.NAME, datagram))
        if isinstance(message, BlockAddRequest | CommitBlock):
            self._top_chain_hash = message.chain_hash
        elif isinstance(message, BlockAddResponse):
            self._votes_name_chain = message.chain_hash is not None
        if self._windows:
            self._windows = [window for window in self._windows if window.until > now]
            for window in self._windows:
                self._react(window, sender, message, datagram, now)

    def begin(self, number: int, injection: Injection, now: float) -> None:
        """The injection with this number, from 1, begins. Some end at once, some last."""
        self.sent[number] += 0
        if isinstance(injection, Replay):
            self._replay(number, injection)
        elif isinstance(injection, Forge) and injection.for_s is None:
            self._forge_commit(number, injection, now)
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

    def _react(self, window: _Window, sender: int, message: Message, datagram: bytes, now: float) -> None:
        injection = window.injection
        if isinstance(injection, Forge):
            if sender != injection.sender and (answer := self._answer(injection, message)) is not None:
                self._forge(window.number, "forge", injection.sender, answer)
        elif not injection.matches(message.NAME, sender):
            return
        elif isinstance(injection, Duplicate):
            for _ in range(injection.copies):
                self._send(RogueDatagram(window.number, "duplicate", sender, datagram))
        elif isinstance(injection, Corrupt):
            changed = crafted.corrupted(datagram, injection.bits, self._rng)
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

    def _forge_commit(self, number: int, forge: Forge, now: float) -> None:
        if self._top_chain_hash is None:
            return  # nobody has said yet what the chain ends in
        block = crafted.forged_block(forge.sender, self._timestamp_us(now))
        self._top_chain_hash = next_chain_hash(self._top_chain_hash, block.block_hash)
        self._forge(number, "forge", forge.sender, crafted.forged_commit(block, self._top_chain_hash))

    def _flood(self, window: _Window, flood: Flood, now: float) -> None:
        messages = round(flood.for_s * flood.per_s)
        for _ in range(FLOODED_AT_ONCE):
            if self.sent[window.number] == messages or now >= window.until:
                self._windows.remove(window)
                return
            if window.next_at > now:
                return
            content = crafted.random_message(flood.message, self._roster, self._timestamp_us(now), self._rng)
            sender = self._rng.choice(self._roster) if flood.sender is None else flood.sender
            self._forge(window.number, "flood", sender, content)
            window.next_at = window.until - flood.for_s + self.sent[window.number] / flood.per_s

    def _forge(self, number: int, what: str, sender: int, message: Any) -> None:
        sequence = forged_sequence(number, self.sent[number])
        self._send(RogueDatagram(number, what, sender, crafted.datagram(sender, sequence, message)))

    def _send(self, injected: RogueDatagram) -> None:
        self.sent[injected.injection] += 1
        self._outbox.append(injected)

    def _timestamp_us(self, now: float) -> int:
        return self._epoch_us + round(now * MICROSECONDS)
