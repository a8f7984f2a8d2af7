"""Create traces of the agent core for inputs that lead to rare branches. Random inputs and small bounds hardly reach
these branches.

Each function plays one short story of agent 1, and starts with a new agent. In the stories, the agent takes blocks from
the reconcile stack, meets ties in phase 2, and receives answers that no correct agent sends.
"""

from collections.abc import Callable
from typing import Any

from harness.archive.traces import Trace, TraceHeader
from tests.harness.checker.reference.random_inputs import ROSTER
from ucp.agent import Agent
from ucp.block import Block, next_chain_hash
from ucp.events import EVENT_HEADER_BYTES, MAX_EVENT_BYTES, LoggableEvent
from ucp.messages import (
    BlockAddResponse,
    BlockResponse,
    ChainContainResponse,
    CommitBlock,
    Datagram,
    Message,
    NextInSequenceResponse,
)
from ucp.settings import Settings
from ucp.trace import SCHEMA, HandlerRun, RecordedBytes, in_base64

DATA = b"mission"
SMALL_EVENTS = 3
"""Number of events without data that fill a block. One or two such events do not fill it."""


def new_trace(settings: Settings) -> Trace:
    """Return the empty trace of agent 1."""
    used, clock = settings.to_json(), {"epoch_us": 0}
    return Trace(
        TraceHeader(
            schema=SCHEMA, agent_id=1, roster=[*ROSTER], settings=used, clock=clock, initial_data=in_base64(DATA)
        )
    )


class Story:
    """An agent with its trace. The methods give the agent inputs."""

    def __init__(self, settings: dict[str, Any]) -> None:
        full = MAX_EVENT_BYTES + SMALL_EVENTS * EVENT_HEADER_BYTES
        used = Settings(**{"max_block_bytes": full, "max_event_bytes": MAX_EVENT_BYTES, **settings})
        self.agent = Agent(1, ROSTER, DATA, used)
        self.trace = new_trace(used)
        self.now = 0.0

    @property
    def top(self) -> bytes:
        return self.agent.state.chain.top_chain_hash

    def hear(self, message: Message, *senders: int) -> None:
        for sender in senders:
            datagram = RecordedBytes(content=Datagram(sender, 0, message))
            self.agent.receive_message(sender, 0, message, self.now, datagram)
        self._record()

    def log(self, data: bytes) -> None:
        self.agent.add_event(LoggableEvent(7, 1, data), self.now)
        self._record()

    def reconcile(self) -> None:
        self.agent.begin_reconcile(self.now)
        self._record()

    def expire(self) -> None:
        """Let the next running timer expire."""
        ends = self.agent.next_timer()
        assert ends is not None
        self.now = ends
        self.agent.handle_timer(self.now)
        self._record()

    def _record(self) -> None:
        self.trace.runs += [entry for entry in self.agent.trace() if isinstance(entry, HandlerRun)]
        self.agent.messages_to_send()

    def commit(self, *blocks: Block) -> None:
        """Give the agent commits of these blocks by agent 2. Each block extends the agent's chain."""
        for block in blocks:
            self.hear(CommitBlock(block, next_chain_hash(self.top, block.block_hash)), 2)

    def contained(self, contained: bool, *senders: int) -> None:
        """Give the agent answers of phase 1 from these senders, and let the timer of phase 1 expire."""
        self.hear(ChainContainResponse(self.top, contained), *senders)
        self.expire()

    def named(self, block: Block | None, *senders: int, timestamp_us: int | None = None) -> None:
        """Give the agent answers of phase 2 from these senders. They name `block` as the successor.

        If `block` is None, they answer that the chain ends here.
        """
        if block is None:
            self.hear(NextInSequenceResponse(self.top, None, 0), *senders)
            return
        stamp_us = block.timestamp_us if timestamp_us is None else timestamp_us
        self.hear(NextInSequenceResponse(self.top, block.block_hash, stamp_us), *senders)

    def in_phase_2(self) -> None:
        """Begin a reconcile. Agents 2 and 3 answer that they contain this agent's chain, so phase 2 begins."""
        self.reconcile()
        self.contained(True, 2, 3)


def _block(number: int, timestamp_us: int) -> Block:
    return Block(2, timestamp_us, bytes([number]) * 12)


OLD, MIDDLE, NEW = _block(1, 10), _block(2, 20), _block(3, 30)
LOW, HIGH = sorted((_block(4, 20), _block(5, 20)), key=lambda block: block.block_hash)
"""Two blocks with the same timestamp. LOW has the smaller hash."""


def three_events_fill_a_block(story: Story) -> None:
    for _ in range(SMALL_EVENTS):
        story.log(b"")


def vote_arrives_late(story: Story) -> None:
    story.log(bytes(256))
    candidate = story.agent.state.candidate_block
    assert candidate is not None
    story.expire()
    story.hear(BlockAddResponse(candidate.block_hash, True), 2)


def vote_names_another_chain(story: Story) -> None:
    story.log(bytes(256))
    candidate = story.agent.state.candidate_block
    assert candidate is not None
    story.hear(BlockAddResponse(candidate.block_hash, True, MIDDLE.block_hash), 2)
    story.hear(BlockAddResponse(candidate.block_hash, True, story.top), 3)
    story.expire()


def inception_block_is_denied(story: Story) -> None:
    story.reconcile()
    story.contained(False, 2)


def phase_1_ends_with_a_tie(story: Story) -> None:
    story.commit(OLD)
    story.reconcile()
    story.hear(ChainContainResponse(story.top, True), 2)
    story.contained(False, 3)


def one_block_is_named_with_two_timestamps(story: Story) -> None:
    story.in_phase_2()
    story.named(MIDDLE, 2)
    story.named(MIDDLE, 3, timestamp_us=15)
    story.named(OLD, 4, timestamp_us=17)
    story.named(OLD, 5, timestamp_us=17)
    story.expire()


def newer_block_has_the_majority(story: Story) -> None:
    story.in_phase_2()
    story.named(OLD, 2)
    story.named(NEW, 3, 4)
    story.expire()


def older_block_with_the_higher_hash_wins_a_tie(story: Story) -> None:
    story.in_phase_2()
    story.named(LOW, 2, timestamp_us=40)
    story.named(HIGH, 3)
    story.expire()


def older_block_with_the_lower_hash_wins_a_tie(story: Story) -> None:
    story.in_phase_2()
    story.named(LOW, 2)
    story.named(HIGH, 3, timestamp_us=40)
    story.expire()


def lower_hash_wins_a_tie_of_equal_timestamps(story: Story) -> None:
    story.in_phase_2()
    story.named(HIGH, 2)
    story.named(LOW, 3)
    story.expire()


def top_of_chain_ties_with_a_block(story: Story) -> None:
    story.in_phase_2()
    story.named(None, 2)
    story.named(MIDDLE, 3)
    story.expire()


def top_of_chain_has_the_majority(story: Story) -> None:
    story.in_phase_2()
    story.named(None, 2, 3)
    story.named(MIDDLE, 4)
    story.expire()


def blocks_return_from_the_bottom_of_the_stack(story: Story) -> None:
    story.commit(OLD, MIDDLE, NEW)
    story.reconcile()
    story.contained(False, 2)
    story.contained(False, 2)
    story.contained(True, 2)
    for block in (NEW, MIDDLE):
        story.named(block, 2)
        story.expire()
    story.expire()


def stack_returns_after_phase_3_without_a_block(story: Story) -> None:
    story.commit(OLD, MIDDLE, NEW)
    story.reconcile()
    story.contained(False, 2)
    story.contained(False, 2)
    story.contained(True, 2)
    story.named(LOW, 2)
    story.expire()
    story.expire()
    while story.agent.next_timer() is not None:
        story.expire()


def own_waiting_block_is_named(story: Story) -> None:
    story.log(bytes(256))
    own = story.agent.state.blocks_to_be_committed[0]
    story.in_phase_2()
    story.named(own, 2)
    story.expire()
    story.in_phase_2()
    story.expire()


def another_block_arrives_in_phase_3(story: Story) -> None:
    story.in_phase_2()
    story.named(OLD, 2)
    story.expire()
    story.hear(BlockResponse(NEW), 2)
    story.hear(BlockResponse(OLD), 3)


STORIES: tuple[Callable[[Story], None], ...] = (
    three_events_fill_a_block,
    vote_arrives_late,
    vote_names_another_chain,
    inception_block_is_denied,
    phase_1_ends_with_a_tie,
    one_block_is_named_with_two_timestamps,
    newer_block_has_the_majority,
    older_block_with_the_higher_hash_wins_a_tie,
    older_block_with_the_lower_hash_wins_a_tie,
    lower_hash_wins_a_tie_of_equal_timestamps,
    top_of_chain_ties_with_a_block,
    top_of_chain_has_the_majority,
    blocks_return_from_the_bottom_of_the_stack,
    stack_returns_after_phase_3_without_a_block,
    own_waiting_block_is_named,
    another_block_arrives_in_phase_3,
)


def directed_traces(settings: dict[str, Any]) -> list[Trace]:
    """Return the trace of each story. The agent has these settings."""
    traces = []
    for play in STORIES:
        story = Story(settings)
        play(story)
        traces.append(story.trace)
    return traces
