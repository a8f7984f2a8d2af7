"""Encode the recorded steps of agents as numbers, so that the TLA+ module Recorded can read them.

The specification has no hash function and treats hashes as names. This module therefore computes the hashes of blocks
and chains (eq. 3.1 and 3.2). It replaces each block hash by its position among all block hashes, each timestamp by its
position among all timestamps, and each chain hash by the number of the chain.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from harness.archive.traces import Trace
from harness.archive.vocabulary import (
    IGNORED_KINDS,
    tally_is_known,
    timer_that_ended,
    timers_are_known,
    unknown_names,
)
from harness.checker.recorded_inputs import decoded, event_of, sealed_of, stored_blocks
from harness.checker.steps.follower import COUNTING, OptionalTraceFields
from harness.checker.steps.trace_header import CheckedHeader
from ucp.agent import HANDLERS, ON_TIMER, drop_reason
from ucp.block import LATEST_US, Block, InceptionBlock, next_chain_hash
from ucp.messages import (
    CARRY_A_BLOCK,
    TYPE_CODES,
    BlockAddRequest,
    BlockAddResponse,
    ChainContainResponse,
    CommitBlock,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
)
from ucp.sealed import SEAL_BYTES, sealed_to
from ucp.trace import HandlerRun, SentMessage
from ucp.trigger import BootTrigger, EventTrigger, LocalTrigger, MessageTrigger, TimerTrigger

INCEPTION = 1
TOP_OF_CHAIN, NO_HASH, IMPOSSIBLE = 0, -1, -7
LARGEST = 2**31 - 1
"""Largest integer that TLC supports."""
HEARD, TIMER_ENDED, LOGGED, TRIGGERED, ASKED, BOOTED = range(1, 7)
OPERATIONS = {"complete": 1, "chain+": 2, "chain-": 3, "deque+": 4, "deque-": 5, "stack+": 6, "stack-": 7}
TIMERS = {name: number for number, name in enumerate(ON_TIMER, 1)}
NO_HANDLER = 0
ANOTHER_DURATION = 9
NOT_TOLD = (0,)
VOTES, ANSWERS, CANDIDATES, MAJORITY = range(1, 5)
NO_TALLY = VOTES, IMPOSSIBLE
NO_MESSAGE = TYPE_CODES[RequestForBlock], IMPOSSIBLE
"""A message that no agent sends. It stands for a message that cannot be encoded."""


class UnreadableError(Exception):
    """An error: a trace line cannot be encoded for a comparison with the specification. The message is one sentence."""


class EncodedTimestamp(int):
    """A timestamp that waits for its encoding. The encoder replaces it by its position among all timestamps."""


Item = Any
"""A number, a block hash (bytes), an `EncodedTimestamp`, or a tuple of such items."""


@dataclass
class EncodedIncarnation:
    """The encoded steps of an agent between two restarts."""

    agent_id: int
    number: int
    steps: list[Item] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    """The number of the trace line of each step."""
    handlers: list[str] = field(default_factory=list)
    whole: bool = True
    """True if no steps are missing at the end."""
    unread: str | None = None
    """The reason why later lines of the trace could not be encoded. None if all lines are encoded."""


class ChainNumbers:
    """A numbering of chains, in place of chain hashes. The chain that consists of the inception block alone is the
    first one. A chain that extends a numbered chain by a block gets a new number.
    """

    def __init__(self) -> None:
        self.successors: dict[int, dict[bytes, int]] = {INCEPTION: {}}

    def new(self) -> int:
        """Return a number for a chain whose blocks are unknown."""
        number = len(self.successors) + 1
        self.successors[number] = {}
        return number

    def on_top(self, below: int, block_hash: bytes) -> int:
        known = self.successors[below]
        if block_hash not in known:
            known[block_hash] = self.new()
        return known[block_hash]


def lives(trace: Trace, header: CheckedHeader, chains: ChainNumbers, *, ended: bool) -> Iterator[EncodedIncarnation]:
    """Encode the steps of an agent. Yield one object for each incarnation. The first line that cannot be encoded ends
    the steps of its incarnation.

    `ended` is true if the agent reached the end of its mission. The trace then contains the agent's last step.
    """
    parts = OptionalTraceFields.of(trace)
    count = len(trace.starts) + 1
    for number, runs in enumerate(trace.incarnations(), 1):
        is_last = number == count
        life = EncodedIncarnation(
            header.agent_id, number, whole=ended and is_last and not trace.cut_off and trace.problem is None
        )
        if is_last:
            life.unread = trace.problem
        writer = _IncarnationEncoder(header, parts, chains)
        for line, run in runs:
            try:
                life.steps.append(writer.step(run))
            except UnreadableError as error:
                life.whole, life.unread = False, f"line {line}: {error}"
                break
            life.lines.append(line)
            life.handlers.append(run.handler)
        yield life


class _IncarnationEncoder:
    """An encoder for the steps of one agent between two restarts."""

    def __init__(self, header: CheckedHeader, parts: OptionalTraceFields, chains: ChainNumbers) -> None:
        self._header = header
        self._parts = parts
        self._chains = chains
        inception = InceptionBlock(header.initial_data).chain_hash
        self._number_of = {inception: INCEPTION}
        self._tops = [(inception, INCEPTION)]
        self._current = b""
        self._newest_us = -1
        settings = header.settings
        self._durations = {
            "voting": settings.vote_timeout_s,
            "phase one": settings.phase1_timeout_s,
            "phase two": settings.phase2_timeout_s,
            "phase three": settings.phase3_timeout_s,
            "finalize gap": settings.finalize_gap_s,
        }

    def step(self, run: HandlerRun) -> Item:
        """Encode a handler run. Raises UnreadableError if it cannot be compared with the specification."""
        unknown = {kind: word for kind, word in unknown_names([run]).items() if kind not in IGNORED_KINDS}
        if unknown:
            raise UnreadableError(next(iter(unknown.values())))
        algorithm = HANDLERS[run.handler].algorithm
        if run.algorithm != algorithm:
            algorithm = NO_HANDLER
        try:
            came, is_for_nobody = self._encoded_input(run)
            changes = self._changes(run)
            sent = tuple(map(self._sent, run.sent))
            top = self._chain(_digest(run.state.top))
        except ValueError as error:
            raise UnreadableError(f"it cannot be read ({str(error)[:100]})") from None
        state = run.state
        return (
            NO_HANDLER if is_for_nobody else algorithm,
            came,
            changes,
            sent,
            self._started(run),
            self._tally(run),
            (
                state.chain,
                state.deque,
                state.stack,
                int(state.reconciling),
                int(state.idle),
                top,
            ),
        )

    def _encoded_input(self, run: HandlerRun) -> tuple[Item, bool]:
        """Return the encoded input of a handler run, and true if the agent must drop this input. Raises ValueError if
        the input is invalid.
        """
        trigger = run.trigger
        if isinstance(trigger, MessageTrigger):
            sender, _, message = decoded(run.input)
            dropped = drop_reason(self._header.agent_id, self._header.roster, sender, message)
            if isinstance(message, CommitBlock):
                self._on_top(self._tops[-1], message.block.block_hash)
            return (HEARD, sender, *self._message(message)), dropped is not None
        if isinstance(trigger, TimerTrigger):
            return (TIMER_ENDED, TIMERS[timer_that_ended(run, trigger)]), False
        if isinstance(trigger, EventTrigger):
            return self._logged(run), False
        if isinstance(trigger, BootTrigger):
            return self._booted(run, trigger), False
        return (TRIGGERED if isinstance(trigger, LocalTrigger) else ASKED,), False

    def _logged(self, run: HandlerRun) -> Item:
        event = event_of(run.input)
        self._current += event.encode()
        timestamp_us = min(max(event.timestamp_us, self._newest_us + 1), LATEST_US)
        block = Block(self._header.agent_id, timestamp_us, self._sealed(run) or self._current)
        if any(operation == "complete" for operation, _ in run.changes):
            self._current, self._newest_us = b"", timestamp_us
        return (LOGGED, event.encoded_bytes, *_block(block))

    def _sealed(self, run: HandlerRun) -> bytes | None:
        """Return the encrypted data of the completed block. Return None if the mission does not encrypt event data, or
        if the data have a wrong length.
        """
        sealed = sealed_of(run.sealed)
        seals = sealed is not None and sealed_to(self._header.initial_data) is not None
        return sealed if seals and len(sealed or b"") == len(self._current) + SEAL_BYTES else None

    def _booted(self, run: HandlerRun, trigger: BootTrigger) -> Item:
        """Encode the blocks that the agent loaded from its disk at a restart."""
        found: dict[str, list[bytes]] = {"complete": [], "chain+": [], "deque+": [], "stack+": []}
        for operation, block_hash in run.changes:
            if operation not in found or (len(found["chain+"]) == trigger.blocks and operation == "chain+"):
                break
            found[operation].append(_digest(block_hash))
        blocks = {block.block_hash: block for block in stored_blocks(run.input)}
        own = [blocks[block_hash].timestamp_us for block_hash in found["complete"] if block_hash in blocks]
        self._newest_us = max(own, default=-1)

        def flat(hashes: Iterable[bytes]) -> Item:
            items: list[Item] = []
            for block_hash in hashes:
                block = blocks.get(block_hash)
                items += (block_hash, 0, self._header.agent_id) if block is None else _block(block)
            return tuple(items)

        return (BOOTED, *map(flat, found.values()))

    def _changes(self, run: HandlerRun) -> Item:
        items: list[Item] = []
        for operation, text in run.changes:
            block_hash = _digest(text)
            items += (OPERATIONS[operation], block_hash)
            if operation == "chain+":
                self._tops.append(self._on_top(self._tops[-1], block_hash))
            elif operation == "chain-" and len(self._tops) > 1:
                self._tops.pop()
        return tuple(items)

    def _on_top(self, top: tuple[bytes, int], block_hash: bytes) -> tuple[bytes, int]:
        """Return the hash and the number of the chain that results from one more block on top of this chain
        (eq. 3.2).
        """
        digest = next_chain_hash(top[0], block_hash)
        self._number_of[digest] = number = self._chains.on_top(top[1], block_hash)
        return digest, number

    def _chain(self, digest: bytes | None) -> int:
        if digest is None:
            return NO_HASH
        if digest not in self._number_of:
            self._number_of[digest] = self._chains.new()
        return self._number_of[digest]

    def _message(self, message: Message) -> tuple[Item, ...]:
        code = TYPE_CODES[type(message)]
        if isinstance(message, BlockAddRequest):
            return code, message.block_hash, self._chain(message.chain_hash)
        if isinstance(message, BlockAddResponse):
            return code, message.block_hash, int(message.approve), self._chain(message.chain_hash)
        if isinstance(message, RequestForBlock):
            return code, message.block_hash
        if type(message) in CARRY_A_BLOCK:
            chain = (self._chain(message.chain_hash),) if isinstance(message, CommitBlock) else ()
            return (code, *chain, *_block(message.block))  # type: ignore[union-attr]
        chain_number = self._chain(message.chain_hash)  # type: ignore[union-attr]
        if isinstance(message, ChainContainResponse):
            return code, chain_number, int(message.contained)
        if isinstance(message, NextInSequenceResponse):
            successor = TOP_OF_CHAIN if message.block_hash is None else message.block_hash
            return code, chain_number, successor, EncodedTimestamp(message.timestamp_us)
        return code, chain_number

    def _sent(self, sent: SentMessage) -> Item:
        try:
            sender, _, message = decoded(sent.datagram)
        except ValueError:
            return NO_MESSAGE
        return self._message(message) if sender == self._header.agent_id else NO_MESSAGE

    def _started(self, run: HandlerRun) -> Item:
        if not self._parts.timers or not timers_are_known(run):
            return NOT_TOLD
        return tuple(
            TIMERS[name] if self._durations.get(name) == duration_s else ANOTHER_DURATION
            for name, duration_s in (run.started or {}).items()
        )

    def _tally(self, run: HandlerRun) -> Item:
        tally: dict[str, Any] | None = run.tally
        if tally is None or run.branch not in COUNTING or not tally_is_known(run):
            return ()
        counted = HANDLERS[run.handler].tally
        try:
            if counted == "majority_response_block_hash":
                return (MAJORITY, *(map(_digest, tally) if tally else (NO_HASH,)))
            if counted != "reconcile_response_dictionary":
                kind = VOTES if counted == "vote_count" else ANSWERS
                return kind, int(tally.get("yes", 0)), int(tally.get("no", 0))
            items: list[Item] = [CANDIDATES]
            for name, (count, timestamp_us) in tally.items():
                items += (_digest(name) if name else TOP_OF_CHAIN, count, EncodedTimestamp(timestamp_us))
            return tuple(items)
        except (TypeError, ValueError):
            return NO_TALLY


def _block(block: Block) -> tuple[Item, ...]:
    return block.block_hash, EncodedTimestamp(block.timestamp_us), block.agent_id


def _digest(text: str) -> bytes:
    """Return the bytes of a hexadecimal hash. Raises ValueError if the text is invalid."""
    return bytes.fromhex(text)


def module(records: Sequence[EncodedIncarnation], chains: ChainNumbers) -> str:
    """Return the text of the TLA+ module Lives, which contains these encoded steps."""
    items: list[Item] = [life.steps for life in records]
    hashes, stamps = set[bytes](), set[int]()
    for step in _leaves(items):
        if isinstance(step, bytes):
            hashes.add(step)
        elif isinstance(step, EncodedTimestamp):
            stamps.add(int(step))
    for known in chains.successors.values():
        hashes |= known.keys()
    place_of = {block_hash: place for place, block_hash in enumerate(sorted(hashes), 1)}
    rank_of = {stamp: rank for rank, stamp in enumerate(sorted(stamps | {0}))}

    def text(item: Item) -> str:
        if isinstance(item, tuple | list):
            return f"<<{','.join(map(text, item))}>>"
        if isinstance(item, bytes):
            return str(place_of[item])
        if isinstance(item, EncodedTimestamp):
            return str(rank_of[int(item)])
        return str(item if -LARGEST <= item <= LARGEST else IMPOSSIBLE)

    incarnations = ",\n".join(
        f"[id |-> {life.agent_id}, whole |-> {str(life.whole).upper()}, steps |-> {text(life.steps)}]"
        for life in records
    )
    successors = (
        tuple(item for pair in chains.successors[number].items() for item in pair)
        for number in range(1, len(chains.successors) + 1)
    )
    return (
        f"---- MODULE Lives ----\nEXTENDS Integers\nRecords == <<\n{incarnations}\n>>\n"
        f"Successors == <<{','.join(map(text, successors))}>>\n====\n"
    )


def _leaves(item: Item) -> Iterator[Item]:
    if isinstance(item, tuple | list):
        for part in item:
            yield from _leaves(part)
    else:
        yield item
