"""Fuzz target: an agent. The input is a sequence of operations. Each operation is a byte that is followed by its
arguments.

For any sequence of operations, these conditions hold. The agent raises no exception. Dropped datagrams, and messages
that cannot have an effect (`ucp.interest`), change nothing. The trace contains every change. The reference
implementation takes the same steps. The agent can restart from its stored data.
"""

import pickle
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from harness.archive.traces import HEADER, HeldBlocks, Trace
from harness.checker.recorded_inputs import BlockIndex
from harness.checker.steps import wrongly_dropped
from harness.checker.steps.follower import OptionalTraceFields, StepComparer
from harness.checker.steps.trace_header import checked
from tests.fuzz.finding import require
from ucp.agent import Agent
from ucp.block import Block, next_chain_hash
from ucp.events import LoggableEvent
from ucp.interest import MATTERS
from ucp.messages import (
    MAX_DATAGRAM_BYTES,
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
    decode,
    encode,
)
from ucp.settings import Settings
from ucp.store import StoredState
from ucp.trace import DroppedDatagram, HandlerRun, header_line

ROSTER = (1, 2, 3, 4)
INITIAL_DATA = b"fuzz"
MOST_OPERATIONS = 200
SETTINGS = (
    Settings(),
    Settings(max_block_bytes=64, max_event_bytes=64, finalize_gap_s=0.0),
    Settings(vote_names_chain=True, changed_before_tally=True, phase1_tie="pop", phase2_tie="block"),
    Settings(vote_timeout_s=0.5, phase1_timeout_s=0.25, phase2_timeout_s=30.0, max_block_bytes=300),
)
_TIMES_US = (0, 1, 2_000_000, 2**32, 2**63, 2**64 - 1)


class _InputBytes:
    """The bytes of an input, which are read one after another. After the end, `byte` returns 0 and `take` returns no
    bytes.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self._position = data, 0

    @property
    def over(self) -> bool:
        return self._position >= len(self._data)

    def byte(self) -> int:
        self._position += 1
        return self._data[self._position - 1] if self._position <= len(self._data) else 0

    def take(self, count: int) -> bytes:
        self._position += count
        return self._data[self._position - count : self._position]


class _DrivenAgent:
    """An agent to which the operations of an input are applied, and the trace that it has written so far."""

    def __init__(self, settings: Settings) -> None:
        self.now = 0.0
        self.settings = settings
        header = header_line(1, list(ROSTER), INITIAL_DATA, asdict(settings), {"epoch_us": 0, "speedup": 1.0})
        self.trace = Trace(HEADER.validate_json(header))
        self.strangers = [Block(2, 1_000_000, b"of two"), Block(3, 1_000_000, b"of three"), Block(4, 7, bytes(1024))]
        self.agent, self.held = self._born()

    def _born(self) -> tuple[Agent, HeldBlocks]:
        return Agent(1, ROSTER, INITIAL_DATA, self.settings), HeldBlocks()

    def operate(self, program: _InputBytes) -> None:
        operation = program.byte() % 16
        if operation < 9:
            self._hear(program.byte(), self._message(operation, program))
        elif operation == 9:
            self._receive(program.take(program.byte() * 8))
        elif operation < 12:
            self._wait(program.byte() / 16 if operation == 10 else None)
        elif operation < 14:
            event = LoggableEvent(round(self.now * 1e6), 1 + program.byte() % 254, bytes(program.byte()))
            if event.encoded_bytes <= self.settings.max_event_bytes:
                self.agent.add_event(event, self.now)
        elif operation == 14:
            self.agent.begin_reconcile(self.now)
        else:
            self._reboot()

    def _wait(self, seconds: float | None) -> None:
        """Advance the time by `seconds`. If `seconds` is None, advance it until the next timer expires."""
        ends = self.agent.next_timer()
        until = self.now + seconds if seconds is not None else self.now if ends is None else ends
        while ends is not None and ends <= until:
            self.now = ends
            self.agent.handle_timer(ends)
            self.look()
            ends = self.agent.next_timer()
        self.now = until

    def _hear(self, sender: int, message: Message) -> None:
        """Give the agent a message, mostly from another agent of the mission.

        A message that cannot have an effect must not change the agent.
        """
        sender = sender or 1 if sender < 6 else 2 + sender % 3
        matters = sender in ROSTER[1:] and MATTERS[type(message)](self.agent.state, sender, message)
        before = None if matters else _comparable_state(self.agent)
        self.agent.receive_datagram(encode(sender, 5, message), self.now)
        require(matters or _comparable_state(self.agent) == before, "what cannot matter changed the agent")

    def _receive(self, data: bytes) -> None:
        dropped, before = self.agent.dropped.total(), _comparable_state(self.agent)
        self.agent.receive_datagram(data, self.now)
        if self.agent.dropped.total() > dropped:
            require(_comparable_state(self.agent) == before, "a datagram that was dropped changed the agent")

    def _message(self, kind: int, program: _InputBytes) -> Message:
        chain_hash = self._chain_hash(program.byte())
        block = self._block(program.byte())
        block_hash = block.block_hash
        match kind:
            case 0:
                return BlockAddRequest(block_hash, chain_hash)
            case 1:
                vote = program.byte()
                return BlockAddResponse(block_hash, bool(vote & 1), chain_hash if vote & 2 else None)
            case 2:
                top = next_chain_hash(chain_hash, block_hash)
                return CommitBlock(block, top if program.byte() else chain_hash)
            case 3:
                return ChainContainQuery(chain_hash)
            case 4:
                return ChainContainResponse(chain_hash, bool(program.byte() & 1))
            case 5:
                return ChainHashSuccessorQuery(chain_hash)
            case 6:
                choice = program.byte()
                return NextInSequenceResponse(
                    chain_hash, block_hash if choice & 1 else None, _TIMES_US[choice // 2 % len(_TIMES_US)]
                )
            case 7:
                return RequestForBlock(block_hash)
            case _:
                return BlockResponse(block)

    def _chain_hash(self, choice: int) -> bytes:
        """Return the chain hash of a block in the agent's chain, or the hash of the chain with another block on top."""
        chain = self.agent.state.chain
        hashes = [chain_hash for _, chain_hash in chain.with_chain_hashes()][::-1]
        hashes += [chain.inception.chain_hash, self.agent.state.top_chain_hash_at_initiation or bytes(32)]
        hashes += [next_chain_hash(chain.top_chain_hash, block.block_hash) for block in self.strangers]
        return hashes[choice % len(hashes)]

    def _block(self, choice: int) -> Block:
        """Return a block that the agent holds, or a new block from another agent."""
        state = self.agent.state
        blocks = [*self.strangers, *state.blocks_to_be_committed, *state.reconcile_stack[::-1], *state.chain]
        return blocks[choice % len(blocks)]

    def _reboot(self) -> None:
        stored = StoredState.of(self.agent.state)
        self.look()
        self.agent, self.held = self._born()
        self.trace.starts.append(len(self.trace.runs))
        self.agent.boot(stored, self.now)
        state = self.agent.state
        require(
            {block.block_hash for block in stored.blocks()}
            == {block.block_hash for block in StoredState.of(state).blocks()},
            "a block is lost by a reboot",
        )

    def look(self) -> None:
        """Check that the sent messages can be decoded, and that the trace describes all blocks that the agent holds."""
        for datagram in self.agent.datagrams_to_send():
            require(len(datagram) <= MAX_DATAGRAM_BYTES, "it sends what no datagram holds")
            require(decode(datagram).encode() == datagram, "it sends what is read otherwise")
        entries = self.agent.trace()
        self.trace.extend(entries)
        for run in entries:
            if isinstance(run, HandlerRun):
                self.held.replay(run)
                require(self.held.impossible is None, f"its trace: {self.held.impossible}")
                summary, size = run.state, self.held.size
                lengths = summary.chain, summary.deque, summary.stack
                require(lengths == (size["chain"], size["deque"], size["stack"]), "its trace says not all changes")
        require(set(self.held.completed) == {done.hex() for done in self.agent.state.completed}, "completed otherwise")

    def judge(self) -> None:
        """Check that the agent's trace agrees with the reference implementation."""
        header, parts = checked(self.trace.header), OptionalTraceFields.of(self.trace)
        for life in self.trace.incarnations():
            follower = StepComparer(header, parts, BlockIndex(()), lambda since, until: False)
            for line, run in life:
                follower.follow(line, run)
            require(not follower.deviations, f"it deviates: {follower.deviations[:1]}")
            require(follower.lost is None, f"it cannot be followed: {follower.lost}")
        for line, aside in self.trace.numbered_asides():
            require(
                not isinstance(aside, DroppedDatagram) or wrongly_dropped(header, line, aside) is None,
                "wrongly dropped",
            )


def _comparable_state(agent: Agent) -> bytes:
    """Return all data of the agent that determine its later behaviour."""
    state = {name: value for name, value in vars(agent.state).items() if name not in ("now", "running", "changes")}
    return pickle.dumps({**state, "chain": vars(agent.state.chain)})


def run(data: bytes) -> None:
    program = _InputBytes(data)
    driven = _DrivenAgent(SETTINGS[program.byte() % len(SETTINGS)])
    for _ in range(MOST_OPERATIONS):
        if program.over:
            break
        driven.operate(program)
        driven.look()
    driven.judge()


def seeds(flown: Path) -> Iterator[bytes]:
    """Yield sequences of operations that lead to a commit, a lost vote, and a reconcile with all its phases."""
    block = bytes([12, 1, 255, 12, 1, 255, 12, 1, 255, 12, 1, 255])
    for settings in range(len(SETTINGS)):
        yes = bytes([1, 2, 0, 3, 1, 1, 3, 0, 3, 1])
        no = bytes([1, 2, 0, 3, 0, 1, 3, 0, 3, 0])
        yield bytes([settings]) + block + yes + bytes([11])
        yield bytes([settings]) + block + no + bytes([11, 11, 11, 11])
        commits = bytes([2, 2, 0, 0, 1, 2, 3, 0, 1, 1])
        reconcile = bytes([14, 4, 2, 0, 0, 1, 11, 6, 2, 0, 0, 3, 6, 3, 0, 0, 3, 11, 8, 2, 0, 0, 11, 11, 15, 11])
        yield bytes([settings]) + commits + block + reconcile
