"""One agent of the Uniform Chain Protocol.

Theory of operation
-------------------

An agent builds loggable events into blocks, and keeps a chain of its own and others' blocks that it tries to keep
equal to its neighbours' chains. It is a set of 20 event handlers (Algorithms 1-20), each triggered by one of four
things: the vehicle logs an event, a message arrives, a timer expires, or another handler triggers it. The tables
`ON_MESSAGE` and `TIMERS` below say which; `ucp.commit` and `ucp.reconcile` hold the handlers.

Committing: a full block joins the deque. The agent proposes the deque's front, naming the chain that it would go on
top of. For 10 seconds every agent that hears answers whether its own chain is that same one. If more agree than not,
the block is committed and broadcast, and whoever has the same chain follows. If not, chains have parted: reconcile.

Reconciling: blocks are popped onto a stack until the majority of whoever answers contains what is left (phase 1);
then the majority's successors are asked for and committed one by one (phases 2 and 3); then what is left of the stack
goes back on top and is broadcast (finalize). An agent that is asked for the successor of a chain that it does not
have learns that it has diverged, and reconciles as well. While it reconciles, an agent answers nobody.

The agent does no I/O: it never opens a socket, reads a clock, starts a thread or draws from a global random
generator. It is driven, and it answers with what to do:

    agent.receive_datagram(data, now)      agent.add_event(event, now)
    agent.next_timer()                     agent.handle_timer(now)
    agent.datagrams_to_send()              agent.trace()

`now` is mission time in seconds and never goes back. Equal inputs give equal outputs.

A handler runs to its end, then the local events that it triggered run in order, then comes the next input. That is
why there are none of the thesis's re-entrant locks: they guard state between threads, and here is only one. For the
same reason the thesis's tests of a flag before the lock is taken cannot race.

Whatever the radio delivers, the agent counts what is not a well-formed message from another agent on the roster in
`dropped`, and nothing else happens.
"""

from collections import Counter, deque
from collections.abc import Iterable
from random import Random
from typing import Any

from ucp import commit, reconcile
from ucp.block import MAX_AGENT_ID, Block, InceptionBlock
from ucp.chain import Chain
from ucp.events import LoggableEvent
from ucp.handler import EventHandler
from ucp.messages import (
    CARRY_A_BLOCK,
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    MalformedDatagramError,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
    block_named,
    decode,
    encode,
)
from ucp.settings import Quirks, Settings
from ucp.store import Holdings
from ucp.timers import Timer
from ucp.trace import HandlerRun, Sent, State

Trigger = dict[str, int | str]

ON_MESSAGE: dict[type[Message], EventHandler[Any]] = {
    BlockAddRequest: commit.receive_request_add_block,
    BlockAddResponse: commit.receive_vote_add_block,
    CommitBlock: commit.receive_commit_block,
    ChainContainQuery: reconcile.receive_request_chain_contain,
    ChainContainResponse: reconcile.receive_phase_1_response,
    ChainHashSuccessorQuery: reconcile.receive_request_next_in_sequence,
    NextInSequenceResponse: reconcile.receive_response_next_in_sequence,
    RequestForBlock: reconcile.receive_request_block_for_hash,
    BlockResponse: reconcile.receive_response_block_for_hash,
}

ON_TIMER: dict[str, EventHandler[[]]] = {
    "voting": commit.vote_timer_expiration,
    "phase one": reconcile.reconcile_phase_1_timer_expiration,
    "phase two": reconcile.reconcile_phase_2_timer_expiration,
    "phase three": reconcile.reconcile_phase_3_timer_expiration,
    "finalize gap": reconcile.reconcile_finalize,
}

TRIGGERED_LOCALLY: tuple[EventHandler[Any], ...] = (
    commit.build_data_block,
    commit.process_next_deque_block,
    reconcile.reconcile_begin,
    reconcile.reconcile_phase_1,
    reconcile.reconcile_phase_2,
    reconcile.reconcile_phase_3,
    reconcile.reconcile_finalize,
)

HANDLERS: dict[str, EventHandler[Any]] = {
    handler.name: handler
    for handler in sorted(
        {*ON_MESSAGE.values(), *ON_TIMER.values(), *TRIGGERED_LOCALLY}, key=lambda handler: handler.algorithm
    )
}
"""All 20 event handlers by name, in the order of their Algorithms."""


class Agent:
    """The protocol state of one vehicle; the names of its parts are the thesis's.

    `seed` feeds the one random choice that an agent makes, whether a quirk strikes. Raises ValueError for an agent
    ID or roster that is impossible.
    """

    def __init__(
        self,
        agent_id: int,
        roster: Iterable[int],
        initial_data: bytes,
        settings: Settings | None = None,
        *,
        seed: int = 0,
        tracing: bool = True,
    ) -> None:
        self.agent_id = agent_id
        self.roster = frozenset(roster)
        impossible = [member for member in self.roster if not 1 <= member <= MAX_AGENT_ID]
        if impossible:
            raise ValueError(f"agent IDs are 1..{MAX_AGENT_ID}, not {sorted(impossible)}")
        if agent_id not in self.roster:
            raise ValueError(f"agent {agent_id} is not on the roster {sorted(self.roster)}")
        self.settings = settings or Settings()
        self.quirks = Quirks()
        self.now = 0.0

        self.chain = Chain(InceptionBlock(initial_data))
        self.current_block = bytearray()
        self.blocks_to_be_committed: deque[Block] = deque()
        self.completed: list[bytes] = []
        self.newest_block_timestamp_us = -1

        self.voting_timer = Timer("voting")
        self.candidate_block: Block | None = None
        self.top_chain_hash_at_initiation = b""
        self.vote_count = {"yes": 0, "no": 0}
        self.voters: set[int] = set()

        self.reconcile_in_progress = False
        self.reconcile_stack: list[Block] = []
        self.phase_one_timer = Timer("phase one")
        self.reconcile_vote_count = {"yes": 0, "no": 0}
        self.reconcile_responders: set[int] = set()
        self.phase_two_timer = Timer("phase two")
        self.reconcile_response_dictionary: dict[bytes, list[int]] = {}
        self.majority_response_block_hash: bytes | None = None
        self.phase_three_timer = Timer("phase three")
        self.finalize_timer = Timer("finalize gap")

        self.reconciles = 0
        self.chain_changed_at = 0.0
        self.sent: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()

        self._reconcile_timers = (
            self.phase_one_timer,
            self.phase_two_timer,
            self.phase_three_timer,
            self.finalize_timer,
        )
        self._timers = (self.voting_timer, *self._reconcile_timers)
        self._others = self.roster - {agent_id}
        self._rng = Random(seed)
        self._held_aside: set[bytes] = set()  # hashes of the blocks in the deque and on the reconcile stack
        self._triggered: deque[tuple[EventHandler[[]], str]] = deque()
        self._running = ""
        self._sequence = 0
        self._outbox: list[tuple[int, Message]] = []
        self._tracing = tracing
        self._trace: list[HandlerRun] = []
        self._changes: list[tuple[str, str]] = []
        self._announced: list[Sent] = []
        self._state = self._state_now()

    # What drives an agent

    def receive_datagram(self, data: bytes, now: float) -> None:
        """Handle whatever arrived on the broadcast port. Never raises; what is hostile is counted in `dropped`."""
        try:
            sender, sequence, message = decode(data)
        except MalformedDatagramError as malformed:
            self.dropped[malformed.reason] += 1
            return
        self.receive_message(sender, sequence, message, now)

    def receive_message(self, sender: int, sequence: int, message: Message, now: float) -> None:
        """Handle a decoded message, if it is another agent's on the roster and carries only the roster's blocks."""
        if sender not in self._others:
            self.dropped["own sender" if sender == self.agent_id else "sender not on the roster"] += 1
            return
        if type(message) in CARRY_A_BLOCK and message.block.agent_id not in self.roster:  # type: ignore[union-attr]
            self.dropped["block not of the roster"] += 1
            return
        self.received[message.NAME] += 1
        trigger: Trigger = {"message": message.NAME, "from": sender, "seq": sequence}
        self._handle(now, trigger, ON_MESSAGE[type(message)], sender, message)

    def add_event(self, event: LoggableEvent, now: float) -> None:
        """Log an event. Raises ValueError if it is larger than the mission's largest event."""
        largest = self.settings.max_event_bytes
        if len(event.encode()) > largest:
            raise ValueError(f"an event of {len(event.encode())} bytes is more than max_event_bytes {largest}")
        self._handle(now, {"event": event.event_id}, commit.build_data_block, event)

    def next_timer(self) -> float | None:
        """When `handle_timer` has something to do next, in mission seconds; None if no timer runs."""
        soonest = None
        for timer in self._timers:
            deadline = timer.deadline
            if deadline is not None and (soonest is None or deadline < soonest):
                soonest = deadline
        return soonest

    def answers_nobody_until(self) -> float | None:
        """An agent that reconciles answers nobody, and stops only when a timer of the reconcile ends: when that is.

        In mission seconds; None if it does not reconcile, or no such timer runs.
        """
        if self.reconcile_in_progress:
            for timer in self._reconcile_timers:
                if timer.deadline is not None:
                    return timer.deadline
        return None

    def handle_timer(self, now: float) -> None:
        """Run the handlers of all timers that have expired at `now`, the earliest first."""
        while True:
            expired = [timer for timer in self._timers if timer.deadline is not None and timer.deadline <= now]
            if not expired:
                return
            timer = min(expired, key=lambda timer: timer.deadline or 0.0)
            timer.stop()
            self._handle(now, {"timer": timer.name}, ON_TIMER[timer.name])

    def boot(self, found: Holdings, now: float) -> None:
        """Go on from what a former life left on its vehicle's disk; before any other input.

        Timers, votes and the block being built are gone. A reconcile that was going on ends as if nobody had answered
        (Algorithm 20): what is left of the stack goes back on top, and then the deque's front is proposed again.
        """
        self.now = now
        self.reconcile_in_progress = True
        self.completed.extend(found.completed)
        if self._tracing:
            self._changes.extend(("complete", block_hash.hex()) for block_hash in found.completed)
        for block in found.blocks():
            if block.agent_id == self.agent_id:
                self.newest_block_timestamp_us = max(self.newest_block_timestamp_us, block.timestamp_us)
        for block in found.chain:
            self.commit(block)
        for block in found.deque:
            self._push_onto_deque(block)
        for block in found.stack:
            self._push_onto_stack(block)
        self._handle(now, {"boot": len(self.chain)}, reconcile.reconcile_finalize)

    def begin_reconcile(self, now: float) -> None:
        """Reconcile because the operator asks (a final reconcile at the depot, Section 5.1)."""
        self._handle(now, {"operator": "reconcile"}, reconcile.reconcile_begin)

    def messages_to_send(self) -> list[tuple[int, Message]]:
        """What to broadcast, in order, as (sequence, message); empties the outbox."""
        outbox, self._outbox = self._outbox, []
        return outbox

    def datagrams_to_send(self) -> list[bytes]:
        """What to broadcast, in order; empties the outbox."""
        return [encode(self.agent_id, sequence, message) for sequence, message in self.messages_to_send()]

    def trace(self) -> list[HandlerRun]:
        """The handler runs since the last call, in order."""
        trace, self._trace = self._trace, []
        return trace

    @property
    def idle(self) -> bool:
        """No timer armed, no reconcile, nothing triggered and not yet run."""
        return not (self.reconcile_in_progress or self._triggered) and self.next_timer() is None

    # What handlers do

    def trigger(self, handler: EventHandler[[]]) -> None:
        """Trigger a local event: its handler runs after the current one has ended."""
        self._triggered.append((handler, self._running))

    def send(self, message: Message) -> None:
        """Broadcast `message` to the local UVS."""
        self._outbox.append((self._sequence, message))
        self.sent[message.NAME] += 1
        if self._tracing:
            block_hash = block_named(message)
            self._announced.append(Sent(message.NAME, self._sequence, block_hash.hex() if block_hash else None))
        self._sequence += 1

    def holds(self, block_hash: bytes) -> bool:
        """Is the block in the chain, the deque or the reconcile stack?"""
        return block_hash in self.chain or block_hash in self._held_aside

    def complete(self, block: Block) -> None:
        """A block of our own is full: push it onto the back of the deque."""
        self.completed.append(block.block_hash)
        self.newest_block_timestamp_us = block.timestamp_us
        self._changed("complete", block)
        self._push_onto_deque(block)

    def _push_onto_deque(self, block: Block) -> None:
        self.blocks_to_be_committed.append(block)
        self._held_aside.add(block.block_hash)
        self._changed("deque+", block)

    def take_from_deque(self) -> Block:
        block = self.blocks_to_be_committed.popleft()
        self._held_aside.remove(block.block_hash)
        self._changed("deque-", block)
        return block

    def commit(self, block: Block) -> None:
        """Append `block` to the chain, computing its chain hash (eq. 3.2)."""
        self.chain.append(block)
        self.chain_changed_at = self.now
        self._changed("chain+", block)

    def pop_to_stack(self) -> None:
        """Move the chain's top block onto the reconcile stack."""
        block = self.chain.pop()
        self.chain_changed_at = self.now
        self._changed("chain-", block)
        self._push_onto_stack(block)

    def _push_onto_stack(self, block: Block) -> None:
        self.reconcile_stack.append(block)
        self._held_aside.add(block.block_hash)
        self._changed("stack+", block)

    def pop_from_stack(self) -> Block:
        block = self.reconcile_stack.pop()
        self._held_aside.remove(block.block_hash)
        self._changed("stack-", block)
        return block

    def remove_from_stack(self, block_hash: bytes) -> Block | None:
        """Take the block out of the reconcile stack, wherever in it; None if it is not there."""
        for position in range(len(self.reconcile_stack) - 1, -1, -1):  # the mutual successor is mostly on top
            if self.reconcile_stack[position].block_hash == block_hash:
                block = self.reconcile_stack.pop(position)
                self._held_aside.remove(block_hash)
                self._changed("stack-", block)
                return block
        return None

    def quirk_strikes(self, probability: float) -> bool:
        return probability > 0 and self._rng.random() < probability

    # How a handler runs

    def _handle(self, now: float, trigger: Trigger, handler: EventHandler[Any], *inputs: object) -> None:
        """Run a handler, and then those that it triggered, in order."""
        self.now = now
        while True:
            self._running = handler.name
            branch = handler.run(self, *inputs)
            if self._tracing:
                self._trace_run(trigger, handler, branch)
            if not self._triggered:
                return
            handler, by = self._triggered.popleft()
            trigger, inputs = {"local": by}, ()

    def _trace_run(self, trigger: Trigger, handler: EventHandler[Any], branch: str) -> None:
        state = self._state
        if self._changes or state.reconciling != self.reconcile_in_progress or state.idle != self.idle:
            state = self._state = self._state_now()
        self._trace.append(
            HandlerRun(
                self.now, handler.name, handler.algorithm, trigger, branch, self._changes, self._announced, state
            )
        )
        self._changes, self._announced = [], []

    def _state_now(self) -> State:
        return State(
            len(self.chain),
            len(self.blocks_to_be_committed),
            len(self.reconcile_stack),
            self.reconcile_in_progress,
            self.idle,
            self.chain.top_chain_hash.hex(),
        )

    def _changed(self, operation: str, block: Block) -> None:
        if self._tracing:
            self._changes.append((operation, block.block_hash.hex()))
