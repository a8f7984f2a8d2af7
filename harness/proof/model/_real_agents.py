"""Set real agents to explored states, and give them inputs."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from random import Random
from typing import Any

from harness.proof.attacker._security_gate import SecurityGate
from harness.proof.bounds import Bounds
from harness.proof.model._known_states import FIRST
from harness.proof.model._snapshot import NOW_S, ReductionError, Snapshot, put_back, take
from ucp.agent import HANDLERS, Agent
from ucp.block import Block
from ucp.clock import MICROSECONDS
from ucp.events import EVENT_HEADER_BYTES, MAX_EVENT_BYTES, LoggableEvent
from ucp.handler import EventHandler
from ucp.quirks import wrong_handlers

INITIAL_DATA = b"proof"
AT_ONCE_S = 0.05
"""Duration in seconds. A timer with at most this duration expires before any answer can arrive, because a message takes
2 to 50 ms.
"""
MOST_AT_ONCE = 100


class RealAgents:
    """One real agent for each ID, which the prover sets to the states that it explores. If a vehicle is captured, the
    agents check signatures.

    If states are stored without agent IDs (`nameless`), each agent has its own settings, but all agents have the ID of
    the first one.
    """

    def __init__(self, bounds: Bounds) -> None:
        self._bounds = bounds
        self._roster = range(1, bounds.agents + 1)
        self._gate = None if bounds.captured is None else SecurityGate(self._roster, bounds.captured)
        self.by_id = {agent_id: self.new(agent_id) for agent_id in self._roster}
        self._left_in: dict[int, Snapshot] = {}
        """Agent ID -> the current state of the agent, if it is known."""
        self.revoked = {
            agent_id: self.new(agent_id, revoked=True) for agent_id in self._roster if self._gate is not None
        }
        """Agent ID -> an agent that knows that the captured vehicle is revoked."""

    @property
    def gate(self) -> SecurityGate:
        """The keys of the mission and of the attacker. They exist only if a vehicle is captured."""
        assert self._gate is not None, "a vehicle is captured"
        return self._gate

    def new(self, agent_id: int, after_each: Callable[[], None] | None = None, *, revoked: bool = False) -> Agent:
        """Return a new agent. If `after_each` is given, the agent calls it after each handler run, and writes
        traces.
        """
        handlers = wrong_handlers(self._bounds.quirks, Random(0))
        if after_each is not None:
            all_handlers = HANDLERS | {handler.name: handler for handler in handlers}
            handlers = [_calling(handler, after_each) for handler in all_handlers.values()]
        settings, tracing = self._bounds.agent_settings(agent_id), after_each is not None
        make = Agent if self._gate is None else partial(self._gate.agent, revoked=revoked)
        own_id = FIRST if self._bounds.nameless else agent_id
        return make(own_id, self._roster, INITIAL_DATA, settings, handlers=handlers, tracing=tracing)

    def put_into(self, agent_id: int, snapshot: Snapshot) -> Agent:
        """Set the agent with this ID to a state, and return the agent."""
        agent = self.by_id[agent_id]
        put_back(agent, snapshot, self._left_in.pop(agent_id, None))
        return agent

    def leave_in(self, agent_id: int, snapshot: Snapshot) -> None:
        """Record the state in which the agent is now. The next call of `put_into` then replaces only the parts that
        differ, which is faster.
        """
        self._left_in[agent_id] = snapshot

    def made(self, ordinal: int) -> Block:
        """Return block number `ordinal`, as this agent would complete it."""
        agent = self.new(FIRST)
        log(agent, ordinal)
        if agent.state.current_block:
            raise ReductionError("an event remains after a block is completed: try again with --whole")
        (block,) = agent.state.blocks_to_be_committed
        return block


def _calling(handler: EventHandler[Any], after: Callable[[], None]) -> EventHandler[Any]:
    """Return a handler that runs `handler` and then calls `after`."""

    def run(*inputs: Any) -> str:
        branch = handler.run(*inputs)
        after()
        return branch

    return replace(handler, run=run)


def log(agent: Agent, ordinal: int) -> None:
    """Log events on an agent until the block with this number is complete."""
    completed = len(agent.state.completed)
    data = bytes(min(MAX_EVENT_BYTES, agent.state.settings.max_event_bytes) - EVENT_HEADER_BYTES)
    for number in range(MOST_AT_ONCE):
        if len(agent.state.completed) > completed:
            return
        agent.add_event(LoggableEvent(ordinal * MICROSECONDS + number, 1, data), agent.state.now)


def end_timer(timer: int, oldest: bytes | None, agent: Agent) -> None:
    """Let a timer of an agent expire. If `oldest` is given, this candidate becomes the oldest one in phase 2 of the
    reconcile, so that it wins a tie.

    The inception block is older than any candidate.
    """
    if oldest is not None:
        counted = agent.state.reconcile_response_dictionary[oldest]
        counted[1] = min(counted[1], 1)
    agent.end_timer(agent.state.timers[timer], agent.state.now)


def end_at_once(agent: Agent) -> str | None:
    """Run the handlers of very short timers, which expire before any message can arrive. If a handler raises an
    exception, return its text. Otherwise return None.
    """
    now_s = agent.state.now
    try:
        for _ in range(MOST_AT_ONCE):
            soon = [t for t in agent.state.timers if t.deadline is not None and t.deadline <= now_s + AT_ONCE_S]
            if not soon:
                return None
            agent.end_timer(min(soon, key=lambda timer: timer.deadline or 0.0), now_s)
    except Exception as error:  # any exception of a handler is a flaw
        return f"{type(error).__name__}: {error}"
    return "its timers end at once again and again"


def is_heard(agent: Agent, datagram: bytes, before: Snapshot) -> bool:
    """Return true if an agent accepts a datagram that it should drop: its state changes, it sends a message, or it does
    not count the datagram as dropped.
    """
    dropped = agent.dropped.total()
    agent.receive_datagram(datagram, NOW_S)
    unchanged = all(value is before[name] for name, value in take(agent, before).items())
    return not (unchanged and agent.dropped.total() == dropped + 1 and not vars(agent.state)["outbox"])
