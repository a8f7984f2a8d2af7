"""The logic of the rogue node without I/O: it creates forged datagrams from the messages that it receives.

Like `ucp.agent`, it is driven by calls (`receive`, `begin`, `handle_timer`), and `to_send` returns the results. Times
are mission seconds. Equal inputs and seeds give equal outputs.

The rogue node knows the chain of the swarm from received messages. A Block Add Request contains the top chain hash of
its sender before the commit, and a Commit Block contains the chain hash after the commit. A forged block on top of the
newest of these chain hashes meets the conditions of Algorithm 6 at all agents with this chain. The thesis leaves
signatures to the platform (Section 3.3).
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from random import Random
from typing import TYPE_CHECKING, Any

from harness.play.rogue import _crafted
from harness.play.rogue.lies import KnownBlocks, UnknownBlockError
from harness.play.rogue.rogue_line import forged_sequence, line_of
from harness.scenario.injection import CorruptedCopy, DelayedCopy, Duplicate, Flood, Forgery, Injection, Lie, Replay
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
from ucp.secure.envelope import NAMES, REQUEST_OF, read_clear_header
from ucp.secure.envelope import VERSION as SECURED

if TYPE_CHECKING:
    from harness.play.rogue._captured_bundle import CapturedKeys
    from ucp.secure.sealed_datagrams import AnsweredRequest

MAX_REMEMBERED = 10_000
"""Maximum number of received datagrams that the rogue node keeps for replays."""
MAX_WAITING = 100_000
"""Maximum number of datagrams that wait to be sent. If this number is reached, the rogue node creates no further
datagrams.
"""
FLOOD_BATCH = 64
"""Maximum number of messages of a flood that the rogue node sends before it does other work."""


QUERY_OF_ANSWER = {NAMES[answer]: NAMES[query] for answer, query in REQUEST_OF.items()}
"""Name of an answer -> name of the query or request that it answers."""


@dataclass(frozen=True, slots=True)
class RogueDatagram:
    """A datagram that the rogue node sends."""

    injection: int
    """The number of the injection."""
    what: str
    """The kind of the injection."""
    source: int
    """The sender address that the rogue node imitates."""
    datagram: bytes
    plain: bytes | None = None
    """The datagram before encryption, or None if the rogue node did not encrypt it."""
    receivers: Sequence[int] | None = None
    """The receivers of the datagram, or None for a broadcast."""

    def to_json(self, at_s: float) -> dict[str, object]:
        said = self.plain or self.datagram
        return line_of(at_s, self.injection, self.what, self.source, said) | {"bytes": len(self.datagram)}


@dataclass(frozen=True, slots=True)
class _ReceivedDatagram:
    """A datagram that the rogue node received."""

    sender: int
    name: str
    message: Message | None
    """The message in the datagram, or None if the datagram is encrypted and the rogue node cannot decrypt it."""
    request: "AnsweredRequest | None"
    """The identification that an answer to an encrypted datagram must contain. The value is None if the datagram is not
    encrypted, or cannot be decrypted.
    """
    datagram: bytes


@dataclass(slots=True)
class _ActiveInjection:
    """An injection of messages that has begun and not yet ended."""

    number: int
    injection: Injection
    until: float
    """Mission second at which the injection ends."""
    next_at: float
    """Mission second at which a flood of messages sends its next message."""


class RogueLogic:
    """The state of the rogue node: received messages, active injections, and datagrams to send. `epoch_us` is mission
    second 0 on the agents' clocks, in microseconds. `captured` are the keys of a captured vehicle. `initial_data` is
    the data of the inception block, which the rogue node needs to forge messages about chains.
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
        """Number of datagrams of each injection that has begun."""
        self._roster = tuple(roster)
        self._rng = Random(f"{seed}/rogue")
        self._epoch_us = epoch_us
        self._captured = captured
        self._secured = captured is not None
        """True if the rogue node has keys, or has received an encrypted datagram."""
        self._received: deque[tuple[int, str, bytes]] = deque(maxlen=MAX_REMEMBERED)
        self._top_chain_hash: bytes | None = None
        self._votes_name_chain = False
        self._known_blocks = KnownBlocks(initial_data, epoch_us)
        self._queries: dict[tuple[int, str], AnsweredRequest] = {}
        """Sender and type of a query -> identification of the last encrypted query, which an answer must contain."""
        self._windows: list[_ActiveInjection] = []
        self._waiting: list[tuple[float, int, RogueDatagram]] = []
        self._outbox: list[RogueDatagram] = []
        self._made = 0

    def receive(self, datagram: bytes, now: float) -> None:
        """Process a datagram of an agent. Datagrams that are not UCP messages are ignored."""
        try:
            sender, name, message, request = self._read(datagram, now)
        except MalformedDatagramError:
            return
        self._received.append((sender, name, datagram))
        if message is not None:
            self._known_blocks.receive(sender, message)
        if request is not None:
            self._queries[sender, name] = request
        if isinstance(message, BlockAddRequest | CommitBlock):
            self._top_chain_hash = message.chain_hash
        elif isinstance(message, BlockAddResponse):
            self._votes_name_chain = message.chain_hash is not None
        if self._windows:
            self._windows = [window for window in self._windows if window.until > now]
            for window in self._windows:
                self._react(window, _ReceivedDatagram(sender, name, message, request, datagram), now)

    def _read(self, datagram: bytes, now: float) -> tuple[int, str, Message | None, "AnsweredRequest | None"]:
        """Return the sender and the type of a datagram. If the datagram can be decrypted, also return its message and
        its identification. Raises MalformedDatagramError.
        """
        if datagram[2:3] != bytes([SECURED]):
            sender, _, message = decode(datagram)
            return sender, message.NAME, message, None
        clear = read_clear_header(datagram)
        self._secured = True
        opened = self._captured.opened(datagram) if self._captured else None
        return clear.sender, NAMES.get(clear.type, ""), *(opened or (None, None))

    def begin(self, number: int, injection: Injection, now: float) -> None:
        """Begin injection number `number`, counted from 1. If the injection has no duration (a replay, a `lie` or some
        forgeries), it also ends in this call.
        """
        self.sent[number] += 0
        if isinstance(injection, Replay):
            self._replay(number, injection)
        elif isinstance(injection, Forgery) and injection.for_s is None:
            self._forge_commit(number, injection, now)
        elif isinstance(injection, Lie):
            self._lie(number, injection, now)
        else:
            self._windows.append(_ActiveInjection(number, injection, now + injection.lasts_s, now))
            self.handle_timer(now)

    def next_timer(self) -> float | None:
        """Return the time at which `handle_timer` must be called next. Return None if no datagram is scheduled."""
        times = [window.next_at for window in self._windows if isinstance(window.injection, Flood)]
        return min([*times, *(at for at, _, _ in self._waiting[:1])], default=None)

    def handle_timer(self, now: float) -> None:
        """Add the datagrams that are due now to the queue."""
        while self._waiting and self._waiting[0][0] <= now:
            self._outbox.append(heappop(self._waiting)[2])
        for window in list(self._windows):
            if isinstance(window.injection, Flood):
                self._flood(window, window.injection, now)

    def to_send(self) -> list[RogueDatagram]:
        """Return the queued datagrams in order, and empty the queue."""
        outbox, self._outbox = self._outbox, []
        return outbox

    # Reactions to received datagrams

    def _react(self, window: _ActiveInjection, received: "_ReceivedDatagram", now: float) -> None:
        injection, sender, datagram = window.injection, received.sender, received.datagram
        if isinstance(injection, Forgery):
            answer = None if received.message is None else self._answer(injection, received.message)
            if sender != injection.sender and answer is not None:
                self._forge(window.number, "forge", injection.sender, answer, now, received.request)
        elif isinstance(injection, Lie) or not injection.matches(received.name, sender):
            return
        elif isinstance(injection, Duplicate):
            for _ in range(injection.copies):
                self._send(RogueDatagram(window.number, "duplicate", sender, datagram))
        elif isinstance(injection, CorruptedCopy):
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

    def _answer(self, forge: Forgery, query: Message) -> Message | None:
        """Return the forged answer to a query. Return None if the injection `forge` does not answer queries of this
        type.
        """
        approve = bool(forge.approve)
        match query:
            case BlockAddRequest() if forge.message == BlockAddResponse.NAME:
                named = query.chain_hash if self._votes_name_chain else None
                return BlockAddResponse(query.block_hash, approve, named)
            case ChainContainQuery() if forge.message == ChainContainResponse.NAME:
                return ChainContainResponse(query.chain_hash, approve)
            case ChainHashSuccessorQuery() if forge.message == NextInSequenceResponse.NAME:
                return NextInSequenceResponse(query.chain_hash, None, 0)
        return None

    def _replay(self, number: int, replay: Replay) -> None:
        matching = ((sender, data) for sender, name, data in reversed(self._received) if replay.matches(name, sender))
        last = [received for received, _ in zip(matching, range(replay.count), strict=False)]
        for sender, data in reversed(last):
            self._send(RogueDatagram(number, "replay", sender, data))

    def _lie(self, number: int, lie: Lie, now: float) -> None:
        try:
            message = self._known_blocks.message(lie)
        except UnknownBlockError:
            return  # the summary of the injection reports that it sent nothing
        query = QUERY_OF_ANSWER.get(lie.message, "")
        asking = self._roster if lie.receivers is None else lie.receivers
        request = next((self._queries[agent, query] for agent in asking if (agent, query) in self._queries), None)
        self._forge(number, "lie", lie.sender, message, now, request, lie.receivers)

    def _forge_commit(self, number: int, forge: Forgery, now: float) -> None:
        if self._secured and self._top_chain_hash is None:
            self._top_chain_hash = bytes(HASH_BYTES)  # the top chain hash is sealed, so it can only guess
        if self._top_chain_hash is None:
            return  # no agent has sent its top chain hash yet
        block = _crafted.forged_block(forge.sender, self._timestamp_us(now))
        self._top_chain_hash = next_chain_hash(self._top_chain_hash, block.block_hash)
        self._forge(number, "forge", forge.sender, _crafted.forged_commit(block, self._top_chain_hash), now)

    def _flood(self, window: _ActiveInjection, flood: Flood, now: float) -> None:
        messages = round(flood.for_s * flood.per_s)
        for _ in range(FLOOD_BATCH):
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
        request: "AnsweredRequest | None" = None,
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
