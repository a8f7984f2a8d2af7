"""The reference implementation as an agent without I/O. It has the same interface as `ucp.agent.Agent`.

`prove` puts the reference agent into the state of a real agent and gives the same input to both. `conformance` runs the
reference agent next to the agent under test.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from harness.checker.reference import why_not_handled
from harness.checker.reference.algorithms import ON_LOCAL_EVENT, ON_MESSAGE, ON_TIMER, tally_of
from harness.checker.reference.state import Handler, ReferenceState, Settings, Timer
from ucp.block import Block
from ucp.events import LoggableEvent
from ucp.messages import MalformedDatagramError, Message, decode, encode
from ucp.trace import HandlerRun, SentMessage, StateSummary
from ucp.trigger import BootTrigger, EventTrigger, LocalTrigger, MessageTrigger, OperatorTrigger, TimerTrigger, Trigger


class StoredBlocks(Protocol):
    """The blocks that an agent stored on disk, and the hashes of the blocks that the agent completed."""

    @property
    def completed(self) -> Sequence[bytes]: ...
    @property
    def chain(self) -> Sequence[Block]: ...
    @property
    def deque(self) -> Sequence[Block]: ...
    @property
    def stack(self) -> Sequence[Block]: ...


class ReferenceAgent:
    """An agent that follows the reference implementation. All times are mission seconds. The attribute `state` is
    public: callers may change it to put the agent into any state. The agent calls `after_each` after each handler run.
    """

    def __init__(
        self,
        agent_id: int,
        roster: Iterable[int],
        initial_data: bytes,
        settings: Settings,
        after_each: Callable[[], None] | None = None,
    ) -> None:
        self.agent_id = agent_id
        self.roster = frozenset(roster)
        self.state = ReferenceState(agent_id, initial_data, settings)
        self._after_each = after_each
        self._outbox: list[tuple[int, Message]] = []
        self._trace: list[HandlerRun] = []

    # Inputs

    def receive_datagram(self, data: bytes, now: float) -> None:
        """Handle a datagram from the broadcast port. Invalid datagrams are dropped."""
        try:
            sender, sequence, message = decode(data)
        except MalformedDatagramError:
            return
        self.receive_message(sender, sequence, message, now)

    def receive_message(self, sender: int, sequence: int, message: Message, now: float) -> None:
        """Handle a message. Messages that the agent must ignore are dropped."""
        if why_not_handled(self.agent_id, self.roster, sender, message) is None:
            trigger = MessageTrigger(message.NAME, sender, sequence)
            self._handle(now, trigger, ON_MESSAGE[type(message)], sender, message)

    def add_event(self, event: LoggableEvent, now: float) -> None:
        """Add an event of the vehicle to the block under construction."""
        self._handle(now, EventTrigger(event.event_id), ON_LOCAL_EVENT["Build Data Block"], event)

    def next_timer(self) -> float | None:
        """Return the mission second at which the next timer expires, or None if no timer runs."""
        timer = self._soonest()
        return None if timer is None else timer.deadline

    def handle_timer(self, now: float) -> None:
        """Run the handlers of all timers that have expired by `now`, earliest first."""
        while (timer := self._soonest()) is not None and timer.deadline is not None and timer.deadline <= now:
            self.end_timer(timer, now)

    def end_timer(self, timer: Timer, now: float) -> None:
        """End a running timer at the time `now`, and run its handler."""
        timer.stop()
        self._handle(now, TimerTrigger(timer.name), ON_TIMER[timer.name])

    def boot(self, stored: StoredBlocks, now: float) -> None:
        """Start the agent with the state that it stored on disk before the power failure."""
        self.state.now = now
        self.state.restore(stored.completed, stored.chain, stored.deque, stored.stack)
        self._handle(now, BootTrigger(len(self.state.chain)), ON_LOCAL_EVENT["Reconcile Finalize"])

    def begin_reconcile(self, now: float) -> None:
        """Begin a reconcile because the operator requested it."""
        self._handle(now, OperatorTrigger("reconcile"), ON_LOCAL_EVENT["Reconcile Begin"])

    # Outputs

    def messages_to_send(self) -> list[tuple[int, Message]]:
        """Return the messages to broadcast, with their sequence numbers. Remove these messages from the output."""
        sent, self._outbox = self._outbox, []
        return sent

    def datagrams_to_send(self) -> list[bytes]:
        """Return the datagrams to broadcast. Remove these datagrams from the output."""
        return [encode(self.agent_id, sequence, message) for sequence, message in self.messages_to_send()]

    def trace(self) -> list[HandlerRun]:
        """Return the handler runs since the previous call of this method."""
        trace, self._trace = self._trace, []
        return trace

    def _soonest(self) -> Timer | None:
        soonest, ends = None, math.inf
        for timer in self.state.timers:
            if timer.deadline is not None and timer.deadline < ends:
                soonest, ends = timer, timer.deadline
        return soonest

    def _handle(self, now: float, trigger: Trigger, handler: Handler, *inputs: object) -> None:
        """Run a handler. Then run the handlers of all local events that it triggered, in order."""
        state = self.state
        state.now = now
        self._run(trigger, handler, *inputs)
        while state.triggered:
            event, by = state.triggered.popleft()
            self._run(LocalTrigger(by), ON_LOCAL_EVENT[event])

    def _run(self, trigger: Trigger, handler: Handler, *inputs: object) -> None:
        state = self.state
        state.running = handler
        branch = handler.run(state, *inputs)
        summary = StateSummary(
            len(state.chain),
            len(state.blocks_to_be_committed),
            len(state.reconcile_stack),
            state.reconcile_in_progress,
            state.idle,
            state.chain.top_chain_hash.hex(),
        )
        sent = [SentMessage.of(self.agent_id, sequence, message) for sequence, message in state.outbox]
        run = HandlerRun(state.now, handler.name, handler.algorithm, trigger, branch, state.changes, sent, summary)
        run.tally, run.started = tally_of(state, handler), state.started or None
        self._trace.append(run)
        self._outbox += state.outbox
        state.changes, state.outbox, state.started = [], [], {}
        if self._after_each is not None:
            self._after_each()
