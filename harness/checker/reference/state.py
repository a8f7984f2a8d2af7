"""The state of one agent in the reference implementation: settings, timers, chain, and the variables of the
pseudo-code.

`algorithms` has the 20 handlers that read and change it. "Reading 4" in a docstring means number 4 of
docs/reference/readings.md.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields

from ucp.block import Block, InceptionBlock, next_chain_hash
from ucp.messages import Message


@dataclass(frozen=True)
class Settings:
    """The protocol settings of an agent. The defaults are the values in the thesis."""

    vote_timeout_s: float = 10.0
    phase1_timeout_s: float = 5.0
    phase2_timeout_s: float = 5.0
    phase3_timeout_s: float = 5.0
    finalize_gap_s: float = 0.1
    max_block_bytes: int = 1024
    max_event_bytes: int = 267
    vote_names_chain: bool = False
    changed_before_tally: bool = False
    phase1_tie: str = "phase2"  # or "pop"
    phase2_tie: str = "oldest"  # or "block"
    asks_after_commit: bool = False  # extends the thesis
    top_needs_majority: bool = False  # extends the thesis
    answer_spread_s: float = 0.0  # extends the thesis: handlers send answers as usual, and the driver delays them

    @classmethod
    def of(cls, settings: object) -> "Settings":
        """Convert an object with the same attributes to settings of this class."""
        return cls(**{setting.name: getattr(settings, setting.name) for setting in fields(cls)})


class Timer:
    """A timer that can be paused (Section 3.2). `deadline` is a mission second, or None while the timer is stopped."""

    __slots__ = ("_paused_at", "deadline", "name")

    def __init__(self, name: str) -> None:
        self.name = name
        self.deadline: float | None = None
        self._paused_at: float | None = None

    @property
    def active(self) -> bool:
        """True if the timer was started and neither expired nor was stopped. A paused timer is active."""
        return self.deadline is not None

    def start(self, now: float, duration_s: float) -> None:
        self.deadline, self._paused_at = now + duration_s, None

    def stop(self) -> None:
        self.deadline = self._paused_at = None

    def pause(self, now: float) -> None:
        if self.deadline is not None and self._paused_at is None:
            self._paused_at = now

    def resume(self, now: float) -> None:
        """Continue a paused timer. Its deadline is later by the duration of the pause."""
        if self.deadline is not None and self._paused_at is not None:
            self.deadline, self._paused_at = self.deadline + (now - self._paused_at), None


class Chain:
    """The local chain (Section 3.4), from the oldest to the newest block. Length and iteration exclude the inception
    block.
    """

    def __init__(self, inception: InceptionBlock) -> None:
        self.inception = inception
        self.top_chain_hash = inception.chain_hash
        self._blocks: dict[bytes, Block] = {}
        self._chain_hashes = [inception.chain_hash]
        self._successors: dict[bytes, Block | None] = {inception.chain_hash: None}

    def __len__(self) -> int:
        return len(self._blocks)

    def __iter__(self) -> Iterator[Block]:
        return iter(self._blocks.values())

    def __contains__(self, block_hash: object) -> bool:
        return block_hash in self._blocks

    def contains_chain_hash(self, chain_hash: bytes) -> bool:
        return chain_hash in self._successors

    def get(self, block_hash: bytes) -> Block | None:
        return self._blocks.get(block_hash)

    def successor(self, chain_hash: bytes) -> Block | None:
        """Return the block that follows `chain_hash` in the chain. Return None if the chain does not contain this chain
        hash, or if this chain hash is the top.
        """
        return self._successors.get(chain_hash)

    @property
    def top_timestamp_us(self) -> int:
        """The timestamp of the top block in microseconds. It is 0 if the chain is empty (reading 9)."""
        return next(reversed(self._blocks.values())).timestamp_us if self._blocks else 0

    def append(self, block: Block) -> None:
        """Append a block to the chain. Its chain hash is H(top chain hash || block hash) (eq. 3.2)."""
        if block.block_hash in self._blocks:
            raise ValueError(f"the chain holds block {block.block_hash.hex()} already; append each block once")
        self._blocks[block.block_hash] = self._successors[self.top_chain_hash] = block
        self.top_chain_hash = next_chain_hash(self.top_chain_hash, block.block_hash)
        self._chain_hashes.append(self.top_chain_hash)
        self._successors[self.top_chain_hash] = None

    def pop(self) -> Block:
        """Remove the newest block of the chain and return it."""
        if not self._blocks:
            raise IndexError("only the inception block is left, and it stays; check len(chain) first")
        _, block = self._blocks.popitem()
        del self._successors[self._chain_hashes.pop()]
        self.top_chain_hash = self._chain_hashes[-1]
        self._successors[self.top_chain_hash] = None
        return block


@dataclass(frozen=True, eq=False)
class Handler:
    """An event handler of the protocol."""

    name: str
    algorithm: int
    """The Algorithm number of the handler in the thesis."""
    run: Callable[..., str]
    """The function that performs the Algorithm."""
    tally: str | None = None
    """Name of the attribute of `ReferenceState` in which the handler counts votes or answers, or stores the chosen
    block. None for all other handlers.
    """


class ReferenceState:
    """The state of one agent: the variables of the pseudo-code, and the effects of the handler that is running."""

    running: Handler
    """The handler that is running. The caller sets it before each run."""

    def __init__(self, agent_id: int, initial_data: bytes, settings: Settings) -> None:
        self.agent_id = agent_id
        self.settings = settings
        self.now = 0.0
        # Blocks
        self.chain = Chain(InceptionBlock(initial_data))
        self.current_block = bytearray()
        self.blocks_to_be_committed: deque[Block] = deque()
        self.completed: list[bytes] = []
        self.newest_block_timestamp_us = -1
        # Commit process
        self.voting_timer = Timer("voting")
        self.candidate_block: Block | None = None
        self.top_chain_hash_at_initiation = b""
        self.vote_count = {"yes": 0, "no": 0}
        self.voters: set[int] = set()
        # Reconcile process
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
        phases = (self.phase_one_timer, self.phase_two_timer, self.phase_three_timer)
        self.reconcile_timers = (*phases, self.finalize_timer)
        self.timers = (self.voting_timer, *self.reconcile_timers)
        # Records
        self.triggered: deque[tuple[str, str]] = deque()
        self.changes: list[tuple[str, str]] = []
        self.outbox: list[tuple[int, Message]] = []
        self.sequence = 0
        self.started: dict[str, float] = {}
        self._off_chain: set[bytes] = set()  # hashes of the blocks in the deque and on the reconcile stack

    @property
    def idle(self) -> bool:
        """True if no timer is active, no reconcile is in progress, and no local event waits for its handler (reading
        17).
        """
        if self.reconcile_in_progress:
            return False
        for timer in self.timers:  # this is read after nearly every step, and a loop takes a third of the time of any()
            if timer.active:
                return False
        return not self.triggered

    def holds(self, block_hash: bytes) -> bool:
        """Return true if the block is in the chain, in the deque or on the reconcile stack (characteristic 3)."""
        return block_hash in self.chain or block_hash in self._off_chain

    def note_held(self) -> None:
        """Recompute the set of blocks in the deque and on the reconcile stack, which `holds` uses. Call this method
        after replacing the deque or the reconcile stack.
        """
        self._off_chain = {block.block_hash for block in (*self.blocks_to_be_committed, *self.reconcile_stack)}

    def event_data(self, timestamp_us: int) -> bytes:
        """Return the event data of the block under construction. This class ignores `timestamp_us`, the timestamp of
        the block. A subclass may need it to encrypt the data.
        """
        return bytes(self.current_block)

    def send(self, message: Message) -> None:
        """Broadcast a message to all vehicles in range ("Network send" in the thesis)."""
        self.outbox.append((self.sequence, message))
        self.sequence += 1

    def start(self, timer: Timer, duration_s: float) -> None:
        timer.start(self.now, duration_s)
        self.started[timer.name] = duration_s

    def trigger(self, local_event: str) -> None:
        """Queue a local event. The handler of the event runs after the current handler."""
        self.triggered.append((local_event, self.running.name))

    def changed(self, operation: str, block: Block) -> None:
        """Record that a block was added to or removed from the chain, the deque or the reconcile stack."""
        self.changes.append((operation, block.block_hash.hex()))

    def commit(self, block: Block) -> None:
        """Commit a block to the local chain."""
        self.chain.append(block)
        self.changed("chain+", block)

    def push_deque(self, block: Block) -> None:
        """Append a block to the back of the deque."""
        self.blocks_to_be_committed.append(block)
        self._off_chain.add(block.block_hash)
        self.changed("deque+", block)

    def pop_deque(self) -> Block:
        """Remove the block at the front of the deque and return it."""
        block = self.blocks_to_be_committed.popleft()
        self._off_chain.discard(block.block_hash)
        self.changed("deque-", block)
        return block

    def push_stack(self, block: Block) -> None:
        """Put a block on top of the reconcile stack."""
        self.reconcile_stack.append(block)
        self._off_chain.add(block.block_hash)
        self.changed("stack+", block)

    def pop_stack(self, index: int = -1) -> Block:
        """Remove the block at `index` from the reconcile stack, and return the block. By default, this block is the top
        block.
        """
        block = self.reconcile_stack.pop(index)
        self._off_chain.discard(block.block_hash)
        self.changed("stack-", block)
        return block

    def restore(
        self, completed: Iterable[bytes], chain: Iterable[Block], deque: Iterable[Block], stack: Iterable[Block]
    ) -> None:
        """Load the state that the agent stored before a power failure, and start the agent as if a reconcile were in
        progress.

        `completed` contains the hashes of all blocks that the agent completed. The trace line of the restart lists
        them. The agent may no longer hold some of these blocks, so they are recorded without calling `changed`.
        """
        self.reconcile_in_progress = True
        self.completed = list(completed)
        self.changes += [("complete", block_hash.hex()) for block_hash in self.completed]
        for block in chain:
            self.commit(block)
        for block in deque:
            self.push_deque(block)
        for block in stack:
            self.push_stack(block)
        own = set(self.completed)
        for block in (*self.chain, *self.blocks_to_be_committed, *self.reconcile_stack):
            if block.block_hash in own:
                self.newest_block_timestamp_us = max(self.newest_block_timestamp_us, block.timestamp_us)
