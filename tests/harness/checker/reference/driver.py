"""Call the reference implementation in tests. Each method passes one input to the reference implementation, and returns
the resulting handler runs.

The functions bring an agent of the reference implementation into a state in which a test can call its handlers.
The agent under test has ID 1. Agents 2 to 5 exist only as senders of messages.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

from harness.checker.reference.algorithms import HANDLERS
from harness.checker.reference.reference_agent import ReferenceAgent
from harness.checker.reference.state import Handler, Settings, Timer
from ucp.block import Block, next_chain_hash
from ucp.events import LoggableEvent
from ucp.messages import BlockAddResponse, ChainContainResponse, CommitBlock, Datagram, Message, NextInSequenceResponse
from ucp.store import StoredState
from ucp.trace import Tally


class Step(NamedTuple):
    """A run of a handler. `sent` contains each sent message with its sequence number."""

    handler: Handler
    branch: str
    changes: list[tuple[str, str]]
    sent: list[tuple[int, Message]]
    started: dict[str, float]
    tally: Tally | None


class Agent:
    """The reference implementation of one agent of the mission with this `roster`. `now` is the time in mission
    seconds.
    """

    def __init__(
        self, agent_id: int, roster: Iterable[int], initial_data: bytes, settings: Settings | None = None
    ) -> None:
        self._agent = ReferenceAgent(agent_id, roster, initial_data, settings or Settings())
        self.state = self._agent.state

    def receive(self, sender: int, message: Message, now: float) -> list[Step]:
        self._agent.receive_message(sender, 0, message, now)
        return self._steps()

    def log(self, event: LoggableEvent, now: float) -> list[Step]:
        self._agent.add_event(event, now)
        return self._steps()

    def expire(self, timer: Timer | str, now: float) -> list[Step]:
        """Let a timer expire. The timer is given as an object or by its name. A stopped timer does not expire."""
        name = timer if isinstance(timer, str) else timer.name
        expired = next(each for each in self.state.timers if each.name == name)
        if expired.active:
            self._agent.end_timer(expired, now)
        return self._steps()

    def boot(
        self,
        completed: Iterable[bytes],
        chain: Iterable[Block],
        deque: Iterable[Block],
        stack: Iterable[Block],
        now: float,
    ) -> list[Step]:
        self._agent.boot(StoredState(list(completed), list(chain), list(deque), list(stack)), now)
        return self._steps()

    def begin_reconcile(self, now: float) -> list[Step]:
        self._agent.begin_reconcile(now)
        return self._steps()

    def _steps(self) -> list[Step]:
        steps = []
        for run in self._agent.trace():
            sent = []
            for announced in run.sent:
                assert announced.datagram is not None
                datagram = announced.datagram.content
                assert isinstance(datagram, Datagram)
                sent.append((announced.seq, datagram.message))
            handler = HANDLERS[run.handler]
            steps.append(Step(handler, run.branch, run.changes, sent, run.started or {}, run.tally))
        return steps


ROSTER = range(1, 6)
OTHER_HASH = bytes(31) + b"\1"
Trace = list[tuple[str, str]]


def new_agent(agent_id: int = 1, **settings: Any) -> Agent:
    return Agent(agent_id, ROSTER, b"mission", Settings(**settings))


def block_of(agent_id: int, timestamp_us: int) -> Block:
    return Block(agent_id, timestamp_us, b"x")


def trace(steps: list[Step]) -> Trace:
    return [(step.handler.name, step.branch) for step in steps]


def messages(steps: list[Step]) -> list[Message]:
    return [message for step in steps for _, message in step.sent]


def top(agent: Agent) -> bytes:
    return agent.state.chain.top_chain_hash


def complete(agent: Agent, timestamp_us: int = 100, now: float = 0.0) -> list[Step]:
    """Log one event that completes a block, and return the handler runs that this causes."""
    return agent.log(LoggableEvent(timestamp_us, 1, bytes(800)), now)


def receive_commit(agent: Agent, block: Block, now: float = 0.0) -> list[Step]:
    """Deliver a Commit Block message with a block that extends the agent's chain."""
    return agent.receive(2, CommitBlock(block, next_chain_hash(top(agent), block.block_hash)), now)


def agent_with_chain(count: int, **settings: Any) -> Agent:
    """Return an agent whose chain holds blocks of agent 2 with the timestamps 10, 20, 30 and so on."""
    agent = new_agent(**settings)
    for number in range(1, count + 1):
        assert trace(receive_commit(agent, block_of(2, 10 * number))) == [("receive_commit_block", "committed")]
    return agent


def vote(agent: Agent, sender: int, *, approve: bool, chain_hash: bytes | None = None) -> str:
    candidate = agent.state.candidate_block
    assert candidate is not None
    [step] = agent.receive(sender, BlockAddResponse(candidate.block_hash, approve, chain_hash), 1.0)
    return step.branch


def answer_phase_1(agent: Agent, sender: int, *, contained: bool) -> str:
    [step] = agent.receive(sender, ChainContainResponse(top(agent), contained), 1.0)
    return step.branch


def answer_phase_2(agent: Agent, sender: int, block_hash: bytes | None, timestamp_us: int) -> str:
    [step] = agent.receive(sender, NextInSequenceResponse(top(agent), block_hash, timestamp_us), 6.0)
    return step.branch


def agent_in_phase_2(count: int = 0, **settings: Any) -> Agent:
    agent = agent_with_chain(count, **settings)
    agent.begin_reconcile(0.0)
    answer_phase_1(agent, 2, contained=True)
    agent.expire("phase one", 5.0)
    return agent


def agent_in_phase_3(block: Block, **settings: Any) -> Agent:
    agent = agent_in_phase_2(**settings)
    answer_phase_2(agent, 2, block.block_hash, block.timestamp_us)
    agent.expire("phase two", 10.0)
    return agent


def pop_top(agent: Agent, now: float = 0.0) -> list[Step]:
    """Run one round of reconcile phase 1. The only answer in it is "no", so the agent removes its top block."""
    answer_phase_1(agent, 2, contained=False)
    return agent.expire("phase one", now)


def agent_with_stack(chain_count: int, stack_count: int, **settings: Any) -> Agent:
    """Return an agent in reconcile phase 1 that has removed `stack_count` blocks from its chain."""
    agent = agent_with_chain(chain_count + stack_count, **settings)
    agent.begin_reconcile(0.0)
    for _ in range(stack_count):
        pop_top(agent)
    return agent


def agent_in_phase_3_with_stack(stack_count: int, chosen: bytes, **settings: Any) -> tuple[Agent, list[Step]]:
    """Return an agent and its last handler runs. The agent has removed its whole chain, and has then chosen the block
    `chosen` in reconcile phase 2.
    """
    agent = agent_with_stack(0, stack_count, **settings)
    answer_phase_1(agent, 2, contained=True)
    agent.expire("phase one", 5.0)
    answer_phase_2(agent, 2, chosen, 10)
    return agent, agent.expire("phase two", 10.0)
