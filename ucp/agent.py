"""One agent of the Uniform Chain Protocol, without I/O.

Theory of operation
-------------------

An agent collects loggable events in blocks, and holds a chain of its own and other agents' blocks. It keeps this chain
equal to the chains of its neighbours. The agent consists of 20 event handlers (Algorithms 1-20). Each handler has one
of three kinds of triggers: a message arrives, a timer expires, or a local event happens. The vehicle or another handler
triggers a local event. The tables `ON_MESSAGE`, `ON_TIMER` and `ON_LOCAL_EVENT` below map triggers to handlers.
`ucp.commit` and `ucp.reconcile` contain the handlers, and contract/HANDLERS.md draws which handler triggers which.

Commit: a full block joins the deque. The agent proposes the front of the deque, with the top chain hash of its chain.
For 10 seconds all other agents vote: an agent approves if its own chain has the same top chain hash. With a majority of
the votes, the agent commits the block and broadcasts it, and agents with the same chain commit it too. Without a
majority, the chains have diverged, and the agent starts a reconcile.

Reconcile: the agent pops blocks from its chain onto a stack. It stops when the chains of the majority of the answering
agents contain all remaining blocks (phase 1). It asks for the successors in the majority's chain and commits them one
by one (phases 2 and 3). Then it commits the rest of the stack again and broadcasts it (finalize). An agent that is
asked for the successor of a chain hash that it does not have has diverged, and starts a reconcile too. An agent that
reconciles answers no message.

An agent has two interfaces. Its handlers use `ucp.core.Core`: the protocol state and its operations. The caller uses
`Agent`, and may read the state as `agent.state`.

The agent does no I/O: it never opens a socket, reads a clock, starts a thread or draws a random number. The caller
passes input and time, and the agent returns datagrams and the time of its next timer:

    agent.receive_datagram(data, now)      agent.add_event(event, now)
    agent.next_timer()                     agent.handle_timer(now)
    agent.datagrams_to_send()              agent.trace()

`now` is mission time in seconds and never goes back. Equal inputs give equal outputs.

A handler runs to its end. Then the local events that it triggered run in order, and only then the next input. The
thesis has re-entrant locks, which guard the state between threads. An agent has one thread and needs none. In the
thesis, a handler tests a flag before it takes the lock. In this agent no other handler can change the flag in between.

A datagram that is not a well-formed message from another agent on the roster has no effect. `dropped` counts it.
"""

import math
from collections import Counter
from collections.abc import Container, Iterable, Sequence
from typing import Any

from ucp import commit, reconcile
from ucp._answer_spread import Outgoing, WaitingAnswers
from ucp.block import MAX_AGENT_ID
from ucp.core import Core, Seal
from ucp.events import LoggableEvent
from ucp.handler import EventHandler, LocalEvent
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
    decode,
    encode,
)
from ucp.settings import Settings
from ucp.state import AgentState
from ucp.store import StoredState
from ucp.timers import Timer
from ucp.trace import DroppedDatagram, Entry, HandlerRun, RecordedBytes, StateSummary, Tally, in_base64
from ucp.trigger import BootTrigger, EventTrigger, LocalTrigger, MessageTrigger, OperatorTrigger, TimerTrigger, Trigger

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

ON_TIMER: dict[str, EventHandler[[Core]]] = {
    "voting": commit.vote_timer_expiration,
    "phase one": reconcile.reconcile_phase_1_timer_expiration,
    "phase two": reconcile.reconcile_phase_2_timer_expiration,
    "phase three": reconcile.reconcile_phase_3_timer_expiration,
    "finalize gap": reconcile.reconcile_finalize,
}

ON_LOCAL_EVENT: dict[LocalEvent, EventHandler[Any]] = {
    "Build Data Block": commit.build_data_block,
    "Process Next Deque Block": commit.process_next_deque_block,
    "Reconcile Begin": reconcile.reconcile_begin,
    "Reconcile Phase 1": reconcile.reconcile_phase_1,
    "Reconcile Phase 2": reconcile.reconcile_phase_2,
    "Reconcile Phase 3": reconcile.reconcile_phase_3,
    "Reconcile Finalize": reconcile.reconcile_finalize,
}

HANDLERS: dict[str, EventHandler[Any]] = {
    handler.name: handler
    for handler in sorted(
        {*ON_MESSAGE.values(), *ON_TIMER.values(), *ON_LOCAL_EVENT.values()}, key=lambda handler: handler.algorithm
    )
}
"""All 20 event handlers by name, in the order of their Algorithms."""


class Agent:
    """A UCP agent without I/O: the caller passes inputs and the time, and sends the messages that the agent returns.

    `agent_id` is 1 to 65535. `roster` holds the IDs of all agents. `initial_data` is the data of the inception block.
    It is the same for all agents of a mission. `handlers` are wrong handlers that replace the correct handlers of the
    same names (see `ucp.quirks`). `seal` is a function that encrypts event data. If `tracing` is true, the method
    `trace` returns each handler run. All times are mission seconds. The caller may read `state` but must not change it.

    Call `receive_datagram(data, now)` and `add_event(event, now)` for input, and `handle_timer(now)` when
    `next_timer()` is due. After each call, broadcast what `datagrams_to_send()` returns. Raises ValueError for an
    impossible ID or roster.
    """

    def __init__(
        self,
        agent_id: int,
        roster: Iterable[int],
        initial_data: bytes,
        settings: Settings | None = None,
        *,
        handlers: Sequence[EventHandler[Any]] = (),
        tracing: bool = True,
        seal: Seal | None = None,
    ) -> None:
        self.agent_id = agent_id
        self.roster = frozenset(roster)
        impossible = [member for member in self.roster if not 1 <= member <= MAX_AGENT_ID]
        if impossible:
            raise ValueError(f"agent IDs are 1..{MAX_AGENT_ID}, not {sorted(impossible)}")
        if agent_id not in self.roster:
            raise ValueError(f"agent {agent_id} is not on the roster {sorted(self.roster)}")
        self.received: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self._core = Core(agent_id, initial_data, settings or Settings(), tracing=tracing, seal=seal)
        self.state: AgentState = self._core
        spread_s = self.state.settings.answer_spread_s
        self._waiting_answers = WaitingAnswers(agent_id, spread_s) if spread_s else None
        self._tracing = tracing
        self._trace: list[Entry] = []
        self._traced_state = self._state_summary()
        self._on_message, self._on_timer, self._on_local_event = ON_MESSAGE, ON_TIMER, ON_LOCAL_EVENT
        if handlers:
            self.replace_handlers(handlers)

    def replace_handlers(self, wrong: Iterable[EventHandler[Any]]) -> None:
        """Use these handlers in place of the correct handlers of the same names. All other handlers become correct
        again.
        """
        handlers = HANDLERS | {handler.name: handler for handler in wrong}
        self._on_message = {message: handlers[handler.name] for message, handler in ON_MESSAGE.items()}
        self._on_timer = {timer: handlers[handler.name] for timer, handler in ON_TIMER.items()}
        self._on_local_event = {event: handlers[handler.name] for event, handler in ON_LOCAL_EVENT.items()}

    # Inputs

    def receive_datagram(self, data: bytes, now: float) -> None:
        """Handle a datagram from the broadcast port. The method never raises an exception for an invalid datagram. It
        drops the datagram and counts it in `dropped`.
        """
        try:
            sender, sequence, message = decode(data)
        except MalformedDatagramError as malformed:
            self._drop(now, malformed.reason, RecordedBytes(in_base64(data)))
            return
        self.receive_message(sender, sequence, message, now, RecordedBytes(in_base64(data)))

    def receive_message(
        self, sender: int, sequence: int, message: Message, now: float, datagram: RecordedBytes | None = None
    ) -> None:
        """Handle a decoded message, or drop it if `drop_reason` returns a reason.

        `datagram` is the encoded message, which the trace records. Dropped messages are counted in `dropped`.
        """
        if reason := drop_reason(self.agent_id, self.roster, sender, message):
            self._drop(now, reason, datagram)
            return
        self.received[message.NAME] += 1
        core, handler = self._core, self._on_message[type(message)]
        core.now, core.running = now, handler
        branch = handler.run(core, sender, message)
        if self._tracing:
            self._trace_run(MessageTrigger(message.NAME, sender, sequence), datagram, handler, branch)
        if core.triggered:
            self._run_triggered()

    def add_event(self, event: LoggableEvent, now: float) -> None:
        """Log an event. Raises ValueError if the event is larger than `max_event_bytes`."""
        self.check_size(event)
        trace_input = RecordedBytes(None, event) if self._tracing else None
        self._handle(now, EventTrigger(event.event_id), trace_input, self._on_local_event["Build Data Block"], event)

    def check_size(self, event: LoggableEvent) -> None:
        """Raise ValueError if the event is larger than `max_event_bytes`."""
        largest = self.state.settings.max_event_bytes
        if event.encoded_bytes > largest:
            raise ValueError(f"an event of {event.encoded_bytes} bytes is more than max_event_bytes {largest}")

    def next_timer(self) -> float | None:
        """Return the mission second at which `handle_timer` is due. Return None if no timer or answer is pending."""
        timer = self._next_running_timer()
        deadline = None if timer is None else timer.deadline
        answer_s = self.next_answer()
        if answer_s is None or deadline is None:
            return answer_s if deadline is None else deadline
        return min(answer_s, deadline)

    def next_answer(self) -> float | None:
        """Return the mission second at which the next delayed answer is due. Return None if no answer waits."""
        return None if self._waiting_answers is None else self._waiting_answers.next_s()

    def _next_running_timer(self) -> Timer | None:
        """Return the timer that expires next. Return None if no timer runs."""
        soonest, ends = None, math.inf
        for timer in self.state.timers:
            deadline = timer.deadline
            if deadline is not None and deadline < ends:
                soonest, ends = timer, deadline
        return soonest

    def silent_until(self) -> float | None:
        """Return the mission second until which a running reconcile keeps the agent from answering messages.

        This is the expiry of the running timer of the reconcile. Return None if the agent does not reconcile, or if no
        such timer runs.
        """
        if self.state.reconcile_in_progress:
            for timer in self.state.reconcile_timers:
                if timer.deadline is not None:
                    return timer.deadline
        return None

    def handle_timer(self, now: float) -> None:
        """Run the handlers of all timers that have expired by `now`, earliest first, and send the delayed answers that
        are due.
        """
        while (
            (timer := self._next_running_timer()) is not None and timer.deadline is not None and timer.deadline <= now
        ):
            self.end_timer(timer, now)
        self.release_answers(now)

    def release_answers(self, now: float) -> None:
        """Set the time to `now`. The next call of `datagrams_to_send` then also returns the delayed answers that are
        due at this time.
        """
        if self._waiting_answers is not None:
            self._core.now = now

    def end_timer(self, timer: Timer, now: float) -> None:
        """End a running timer at the time `now`, and run its handler."""
        timer.stop()
        self._handle(now, TimerTrigger(timer.name), None, self._on_timer[timer.name])

    def boot(self, recovered: StoredState, now: float) -> None:
        """Restore the state that the agent stored on disk before it ended. Call this before any other input.

        Timers, votes and the current block are lost. A reconcile that was in progress ends as if no agent had answered
        (Algorithm 20). The agent commits the rest of the stack to its chain again, and then proposes the front of the
        deque again.
        """
        core = self._core
        core.now = now
        core.restore(recovered.completed, recovered.chain, recovered.deque, recovered.stack)
        trace_input = RecordedBytes(None, recovered) if self._tracing else None
        self._handle(now, BootTrigger(len(core.chain)), trace_input, self._on_local_event["Reconcile Finalize"])

    def begin_reconcile(self, now: float) -> None:
        """Start a reconcile because the operator requested it (the final reconcile of a mission, Section 5.1)."""
        self._handle(now, OperatorTrigger("reconcile"), None, self._on_local_event["Reconcile Begin"])

    def messages_to_send(self) -> list[tuple[int, Message]]:
        """Return the messages that handlers have sent since the previous call, in order, as (sequence number, message).

        The setting `answer_spread_s` does not delay these messages. A driver with a network calls `datagrams_to_send`
        instead.
        """
        return [(sequence, message) for sequence, message, _ in self._take_outbox()]

    def _take_outbox(self) -> list[Outgoing]:
        outbox = self._core.outbox
        if outbox:
            self._core.outbox = []
        return outbox

    def _due_to_send(self) -> list[Outgoing]:
        """Return the messages to broadcast now, in order. Answers that the setting `answer_spread_s` still delays are
        not included.
        """
        outbox = self._take_outbox()
        return outbox if self._waiting_answers is None else self._waiting_answers.exchange(outbox, self._core.now)

    def datagrams_to_send(self) -> list[bytes]:
        """Return the datagrams to broadcast now, in order. Answers that the setting `answer_spread_s` still delays are
        not included.
        """
        return [encode(self.agent_id, sequence, message) for sequence, message, _ in self._due_to_send()]

    def trace(self) -> list[Entry]:
        """Return the trace entries since the previous call, in order: runs of handlers, and dropped datagrams."""
        trace, self._trace = self._trace, []
        return trace

    # How a handler runs

    def _drop(self, now: float, reason: str, datagram: RecordedBytes | None) -> None:
        """Count a dropped datagram, and write it to the trace."""
        self.dropped[reason] += 1
        if self._tracing:
            self._trace.append(DroppedDatagram(now, reason, datagram or RecordedBytes("")))

    def _handle(
        self,
        now: float,
        trigger: Trigger,
        trace_input: RecordedBytes | None,
        handler: EventHandler[Any],
        *inputs: object,
    ) -> None:
        """Run a handler, and then all handlers that it triggers, in order. `trace_input` is the input as the trace
        records it.
        """
        core = self._core
        core.now, core.running = now, handler
        branch = handler.run(core, *inputs)
        if self._tracing:
            self._trace_run(trigger, trace_input, handler, branch)
        if core.triggered:
            self._run_triggered()

    def _run_triggered(self) -> None:
        """Run the handlers of all triggered local events, including those that they trigger in turn."""
        core = self._core
        while core.triggered:
            event, by = core.triggered.popleft()
            handler = core.running = self._on_local_event[event]
            branch = handler.run(core)
            if self._tracing:
                self._trace_run(LocalTrigger(by), None, handler, branch)

    def _trace_run(
        self, trigger: Trigger, trace_input: RecordedBytes | None, handler: EventHandler[Any], branch: str
    ) -> None:
        core, state = self._core, self._traced_state
        if core.changes or state.reconciling != core.reconcile_in_progress or state.idle != core.idle:
            state = self._traced_state = self._state_summary()
        run = HandlerRun(
            core.now, handler.name, handler.algorithm, trigger, branch, core.changes, core.announced, state, trace_input
        )
        core.changes, core.announced = [], []
        if handler.tally is not None:
            run.tally = tally_of(core, handler)
        if core.started:
            run.started, core.started = core.started, {}
        if core.sealed is not None:
            run.sealed, core.sealed = RecordedBytes(in_base64(core.sealed)), None
        self._trace.append(run)

    def _state_summary(self) -> StateSummary:
        state = self.state
        return StateSummary(
            len(state.chain),
            len(state.blocks_to_be_committed),
            len(state.reconcile_stack),
            state.reconcile_in_progress,
            state.idle,
            state.chain.top_chain_hash.hex(),
        )


def drop_reason(agent_id: int, roster: Container[int], sender: int, message: Message) -> str | None:
    """Return the reason why the agent drops a valid message. Return None if the agent handles the message."""
    if sender == agent_id:
        return "own sender"
    if sender not in roster:
        return "sender not on the roster"
    if type(message) in CARRY_A_BLOCK and message.block.agent_id not in roster:  # type: ignore[union-attr]
        return "block not of the roster"
    return None


def tally_of(core: Core, handler: EventHandler[Any]) -> Tally | None:
    """Return the counters that the trace records for a run of this handler. If the handler counts votes or answers, the
    result contains all counts. If it chooses a block, the result contains only the count of this block. Return None if
    the handler has no counters.
    """
    if handler.tally is None:
        return None
    if handler.tally == "majority_response_block_hash":
        chosen = core.majority_response_block_hash
        return {} if chosen is None else {chosen.hex(): core.reconcile_response_dictionary.get(chosen, [0])[0]}
    counted: dict[Any, Any] = getattr(core, handler.tally)
    if "yes" in counted:
        return counted.copy()
    return {candidate.hex(): list(count) for candidate, count in counted.items()}
