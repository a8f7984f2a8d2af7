"""Give each recorded input of an agent to the reference implementation, and compare the results.

A `StepComparer` holds a reference agent in the same state as the judged agent. After a difference it replaces the state
of the reference by the recorded state of the judged agent, so that one mistake does not cause further differences.
"""

import math
from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import replace
from typing import Any, NamedTuple

from harness.archive.traces import Trace
from harness.archive.vocabulary import branch_is_known, tally_is_known, timer_that_ended, timers_are_known
from harness.checker.recorded_inputs import BlockIndex, NotOnRecordError, decoded, event_of, sealed_of, stored_blocks
from harness.checker.reference import why_not_handled
from harness.checker.reference.algorithms import HANDLERS, ON_LOCAL_EVENT, ON_TIMER
from harness.checker.reference.state import Handler, ReferenceState, Timer
from harness.checker.steps._adopting_core import StateBeforeStep
from harness.checker.steps._debugger_stop import stop_and_run
from harness.checker.steps.deviation import StepDeviation
from harness.checker.steps.implementation import REFERENCE, CoreImplementation
from harness.checker.steps.trace_header import CheckedHeader
from ucp.block import Block
from ucp.events import MalformedEventsError
from ucp.messages import CARRY_A_BLOCK, MalformedDatagramError, Message
from ucp.trace import HandlerRun, RecordedBytes, StateSummary
from ucp.trigger import BootTrigger, EventTrigger, LocalTrigger, MessageTrigger, OperatorTrigger, TimerTrigger

EVENT_OF = {handler.name: event for event, handler in ON_LOCAL_EVENT.items()}

COUNTING = frozenset(("proposed", "asked", "yes", "no", "new candidate", "counted", "block", "tie: block"))
"""Branches (results of a handler) that depend on counted votes or answers. Only after these branches, the comparison
includes the counts.
"""

LOGS = ON_LOCAL_EVENT["Build Data Block"].name
"""Name of the handler of Algorithm 1, which only logged events trigger."""
PAUSES = "receive_response_block_for_hash"
"""Name of the handler that pauses and continues the phase 3 timer. No record shows this pause."""

TOUCH_A_TIMER = frozenset((PAUSES,))
"""Message handlers that change a timer. The comparison must save the timers before it runs one of these handlers. It
can undo any other message handler with the recorded changes alone.
"""

Delayed = Callable[[float, float], bool]
"""A function that returns true if the agent could not run between two mission seconds, because it was paused or the
machine was busy.
"""


class NotHandledError(Exception):
    """An error: the protocol does not run this handler at this moment. The message is the end of a sentence that begins
    with "it".
    """


class RecordedTimerExpiry(NamedTuple):
    """The expiry of a timer. The handler of the timer ran at mission second `t`. The expiry was due `late_s` mission
    seconds earlier.
    """

    line: int
    t: float
    handler: str
    timer: str
    late_s: float


class OptionalTraceFields(NamedTuple):
    """The optional fields that this trace contains. `tallying` contains the names of the handlers whose trace lines
    list counted votes or answers. `timers` is true if trace lines list the started timers.
    """

    tallying: frozenset[str]
    timers: bool

    @classmethod
    def of(cls, trace: Trace) -> "OptionalTraceFields":
        tallying = frozenset({run.handler for run in trace.runs if run.tally is not None})
        return cls(tallying, timers=any(run.started for run in trace.runs))


class AnotherHandlerError(NotHandledError):
    """An error: the input belongs to the handler `handler`, but the agent ran a different handler."""

    def __init__(self, run: HandlerRun, handler: Handler) -> None:
        ran = HANDLERS[run.handler].algorithm if run.handler in HANDLERS else run.algorithm
        super().__init__(f"ran as Algorithm {ran}, but the input is for Algorithm {handler.algorithm}, {handler.name}")


class StepComparer:
    """A comparison of the handler runs of one agent with the reference implementation, between two restarts of the
    agent.
    """

    def __init__(
        self,
        header: CheckedHeader,
        parts: OptionalTraceFields,
        blocks: BlockIndex,
        was_delayed: Delayed,
        implementation: CoreImplementation = REFERENCE,
    ) -> None:
        self.deviations: list[StepDeviation] = []
        """The differences found so far, in order."""
        self.expiries: list[RecordedTimerExpiry] = []
        """The timer expiries of the reference that the agent handled too, in order."""
        self.lost: str | None = None
        """The reason why the comparison cannot continue, with the number of the trace line. None as long as it can
        continue.
        """
        self.stops_before_handler = False
        """True to stop in the debugger before each handler."""
        self._header = header
        self._parts = parts
        self._blocks = blocks
        self._was_delayed = was_delayed
        self._implementation = implementation
        self._on_message = implementation.on_message
        self._core = implementation.core(header)
        self._timers = {timer.name: timer for timer in self._core.timers}
        self._ran: dict[str, tuple[int, float]] = {}
        """Handlers that ran since the last input. Handler -> number of the trace line, and mission second."""
        self._adopted = False
        """True if a difference was found since the last input. The local events since then may be consequences of the
        difference, so they are not compared.
        """
        self._began = False
        self._none_ends_before = math.inf
        """Time on the agent's clock before which no timer of the reference expires."""
        self._paused = 0, -math.inf
        """The last pause of the phase 3 timer: the number of the trace line, and the time on the agent's clock."""
        self._top, self._top_hex = b"", ""
        self._state: StateSummary | None = None
        """The agent's state at the last comparison, if the reference has not changed since then. A line with the same
        state then needs no further comparison.
        """

    def follow(self, line: int, run: HandlerRun) -> None:
        """Compare this handler run with the reference. Also check that the agent omitted no earlier handler run."""
        if self.lost is not None:
            return
        core, trigger = self._core, run.trigger
        local = _triggered_by(run)
        if core.triggered or local is not None:
            self._triggered(line, run, local)
        core.now = now = self._header.local(run.t)
        if local is None:
            self._ran = {run.handler: (line, run.t)}
            self._adopted = False
            if self._none_ends_before < now - self._header.late_s:
                self._overdue(line, run.t, now)
        else:
            self._ran[run.handler] = line, run.t
        due = self._due(run, now) if self._none_ends_before < now - self._header.early_s else ()
        heard = trigger if isinstance(trigger, MessageTrigger) else None
        may_touch_timers = heard is None or run.handler in TOUCH_A_TIMER
        before = core.before(run) if may_touch_timers else None
        try:
            if heard is not None:
                handler, sender, message = self._message(run, heard)
                core.running = handler
                if self.stops_before_handler:
                    branch = stop_and_run(handler, core, sender, message)
                else:
                    branch = handler.run(core, sender, message)
            else:
                handler, inputs = self._input(line, run, now)
                core.running = handler
                core.recorded_seal = sealed_of(run.sealed)
                if self.stops_before_handler:
                    branch = stop_and_run(handler, core, *inputs)
                else:
                    branch = handler.run(core, *inputs)
        except NotHandledError as error:
            self._differ(line, run.t, run.handler, f"it {error}")
        except (AssertionError, ValueError, KeyError, IndexError):  # the agent is where no agent comes to
            self._differ(line, run.t, run.handler, "it ran in a state in which the protocol does not allow it")
        else:
            self._began = True
            if branch == "another block" and run.handler == PAUSES:
                self._paused = line, now
            if core.started:
                self._none_ends_before = min(self._none_ends_before, self._soonest_end())
            if not self._differs(run, handler, branch, may_touch_timers):
                if core.changes or core.outbox or core.started:
                    core.step_is_over()
                return
            expected = self._expected(run, handler, branch)
            deviation = StepDeviation(self._header.agent_id, line, run.t, run.handler, run=run, expected=expected)
            if not self._callback_is_lost(line, run, due) or not _differ_only_in_idle(run, expected):
                self.deviations.append(deviation)
        self._began = True
        self._adopt(line, run, before)

    def begin_at(self, chain: Iterable[Block], current_block: bytes, sequence: int) -> None:
        """Set the reference to the state of an idle agent with this chain, this block under construction, and this next
        sequence number.
        """
        self._core.be_idle_with(chain, current_block, sequence)
        self._began = True

    @property
    def state(self) -> ReferenceState:
        """The current state of the reference implementation. Callers must not change it."""
        return self._core

    @property
    def roster(self) -> frozenset[int]:
        return self._header.roster

    def mission_s(self, local_s: float) -> float:
        """Return the mission second at which the agent's clock shows `local_s`."""
        return (local_s - self._header.offset_s) / self._header.rate

    def block(self, block_hash: str) -> Block:
        """Return the block with this hash. Raises NotOnRecordError if no record contains it."""
        return self._blocks.get(block_hash)

    # Lines that may be lost

    def has_effect(self, sender: int, message: Message, at_s: float) -> bool:
        """Let the reference handle a message that the trace lacks. Return true if the message has an effect: a change
        of blocks, a counted answer, a sent message, a started timer or a local event.
        """
        core = self._core
        core.now = self._header.local(at_s)
        core.running = handler = self._on_message[type(message)]
        branch = handler.run(core, sender, message)
        return bool(core.changes or core.outbox or core.started or core.triggered) or branch in COUNTING

    def play_lost_message(self, sender: int, message: Message, at_s: float) -> bool:
        """Let the reference handle a message that the trace lacks. Return true if the message changed no block. Only
        then can a trace lack the line of the message without a contradiction.
        """
        return self._play_lost(self._on_message[type(message)], at_s, sender, message)

    def play_lost_expiry(self, timer_name: str, at_s: float) -> bool:
        """Let a timer of the reference expire, although the trace has no line for the expiry. Return true if the timer
        was due and its handler changed no block. Only then can a trace lack the line of the expiry without a
        contradiction.
        """
        timer = self._timers[timer_name]
        if timer.deadline is None or timer.deadline > self._header.local(at_s) + self._header.early_s:
            return False
        timer.stop()
        return self._play_lost(self._implementation.on_timer[timer_name], at_s)

    def play_lost_local_event(self, at_s: float) -> bool:
        """Run the handler of the next local event. Return true if an event waited and its handler changed no block.
        Only then can a trace lack the line of the handler run without a contradiction.
        """
        if not self._core.triggered:
            return False
        event, _ = self._core.triggered.popleft()
        return self._play_lost(self._implementation.on_local_event[event], at_s)

    def stop_timer(self, timer_name: str) -> None:
        """Stop a timer whose handler the agent never ran."""
        self._timers[timer_name].stop()
        self._none_ends_before = self._soonest_end()

    def _play_lost(self, handler: Handler, at_s: float, *inputs: Any) -> bool:
        core = self._core
        core.now = self._header.local(at_s)
        core.running = handler
        self._state = None
        try:
            handler.run(core, *inputs)
        except (AssertionError, ValueError, KeyError, IndexError):
            return False
        is_hidden = not core.changes
        core.step_is_over()
        self._ran[handler.name] = 0, at_s
        self._none_ends_before = self._soonest_end()
        return is_hidden

    def copy(self) -> "StepComparer":
        """Return an independent copy of this object, without the differences found so far."""
        twin = StepComparer(self._header, self._parts, self._blocks, self._was_delayed, self._implementation)
        keep = [*self._implementation.handlers.values(), *self._core.unchanging()]
        twin._core = deepcopy(self._core, {id(kept): kept for kept in keep})
        twin._timers = {timer.name: timer for timer in twin._core.timers}
        twin.lost, twin.stops_before_handler = self.lost, self.stops_before_handler
        twin._ran = dict(self._ran)
        twin._adopted, twin._began = self._adopted, self._began
        twin._none_ends_before, twin._paused = self._none_ends_before, self._paused
        twin._top, twin._top_hex, twin._state = self._top, self._top_hex, self._state
        return twin

    def foresee(self, line: int, run: HandlerRun) -> list[StepDeviation]:
        """Check the local events before the given handler run. Return a deviation if a local event did not run its
        handler, or if a handler ran without its local event. The check changes nothing in this object and runs no
        handler.
        """
        foreseeing = self.copy()
        if foreseeing.lost is None:
            foreseeing._triggered(line, run, _triggered_by(run))
        return foreseeing.deviations

    def end(self, at_s: float | None) -> None:
        """Report the handlers that should have run before the mission ended at `at_s`, but did not run."""
        if self.lost is not None:
            return
        self._not_run()
        if at_s is not None:
            line = max((line for line, _ in self._ran.values()), default=1)
            self._overdue(line, at_s, self._header.local(at_s))

    # Runs that should have come before

    def _triggered(self, line: int, run: HandlerRun, by: str | None) -> None:
        """Report two kinds of errors: a local event did not run its handler, or a handler ran without its local
        event.
        """
        self._state = None
        triggered = self._core.triggered
        if self._adopted:
            triggered.clear()
            return
        if by is None:
            self._not_run()
            return
        event = EVENT_OF.get(run.handler, "an unknown local event")
        expected, truly_by = triggered[0] if triggered else (None, None)
        is_expected = expected is not None and ON_LOCAL_EVENT[expected].name == run.handler
        if is_expected and by == truly_by:
            triggered.popleft()
            return
        if is_expected:
            what = f"it recorded the trigger {by[:60]}, but the trigger is {truly_by}"
            by = run.handler
        elif by == truly_by:
            what = f"it triggered {event}; it should have triggered {expected}"
        elif by in self._ran:
            what = f"it triggered {event}; it should not have triggered this, or not twice"
        else:
            what = "it ran without a trigger"
            by = run.handler
        at_line, at_s = self._ran.get(by, (line, run.t))
        self._differ(at_line, at_s, by, what)
        triggered.clear()
        self._adopted = True

    def _not_run(self) -> None:
        """Report a handler that was triggered but did not run before the agent's next input."""
        triggered = self._core.triggered
        if triggered and not self._adopted:
            event, by = triggered[0]
            self._differ(*self._ran[by], by, f"it triggered nothing; it should have triggered {event}")
        triggered.clear()

    def _overdue(self, line: int, at_s: float, now: float) -> None:
        """Report timers that expired long ago, but whose handlers did not run."""
        self._state = None
        late = now - self._header.late_s
        for timer in self._core.timers:
            if timer.deadline is not None and timer.deadline < late:
                ended_s = at_s - (now - timer.deadline) / self._header.rate
                if not self._was_delayed(ended_s, at_s):
                    what = f"it did not run, although the {timer.name} timer expired at t={ended_s:g} s"
                    if timer is self._core.phase_three_timer:
                        what += self._after_a_pause(timer.deadline)
                    self._differ(line, at_s, ON_TIMER[timer.name].name, what)
                    timer.stop()
        self._none_ends_before = self._soonest_end()

    def _due(self, run: HandlerRun, now: float) -> list[Timer]:
        """Return the timers that have expired but whose handlers have not yet run."""
        due_before = now - self._header.early_s
        return [
            timer
            for timer in self._core.timers
            if timer.deadline is not None and timer.deadline < due_before and ON_TIMER[timer.name].name != run.handler
        ]

    def _callback_is_lost(self, line: int, run: HandlerRun, due: Iterable[Timer]) -> bool:
        """Report each expired timer that the agent stopped or restarted without running the handler of the timer. The
        missing handler run causes the differences that follow. Return true if such a timer was found.
        """
        is_lost = False
        for timer in due:
            if timer.deadline is not None and (run.state.idle or timer.name in (run.started or {})):
                due_s = self.mission_s(timer.deadline)
                what = f"it did not run, although the {timer.name} timer was due at t={due_s:g} s"
                self._differ(line, run.t, ON_TIMER[timer.name].name, what)
                is_lost = True
        return is_lost

    def _after_a_pause(self, deadline: float) -> str:
        """If a handler paused the phase 3 timer while it was running, return a phrase about this pause. The phrase
        completes a sentence. Otherwise return an empty text.
        """
        line, paused_at = self._paused
        if paused_at < deadline - self._header.settings.phase3_timeout_s:
            return ""
        return f"; Algorithm 18, {PAUSES}, paused it in line {line}"

    def _soonest_end(self) -> float:
        soonest = math.inf
        for timer in self._core.timers:
            deadline = timer.deadline
            if deadline is not None and deadline < soonest:
                soonest = deadline
        return soonest

    # Inputs

    def _input(self, line: int, run: HandlerRun, now: float) -> tuple[Handler, tuple[Any, ...]]:
        """Return the handler for an input and the arguments of the handler. The input is an event, an expired timer, a
        local event, a restart or a command, but no message. Raises NotHandledError if no handler matches.
        """
        trigger, on_local_event = run.trigger, self._implementation.on_local_event
        handler: Handler
        inputs: tuple[Any, ...]
        if isinstance(trigger, LocalTrigger):
            handler, inputs = self._local(run), ()
        elif isinstance(trigger, TimerTrigger):
            handler, inputs = self._timer(line, run, timer_that_ended(run, trigger), now), ()
        elif isinstance(trigger, EventTrigger):
            handler, inputs = on_local_event["Build Data Block"], self._event(run.input, trigger.event_id)
        elif trigger == OperatorTrigger("reconcile"):
            handler, inputs = on_local_event["Reconcile Begin"], ()
        elif isinstance(trigger, BootTrigger):
            self._boot(run)
            handler, inputs = on_local_event["Reconcile Finalize"], ()
        else:
            raise NotHandledError("ran without a known trigger")
        if handler.name != run.handler:
            raise AnotherHandlerError(run, handler)
        return handler, inputs

    def _local(self, run: HandlerRun) -> Handler:
        if run.handler not in EVENT_OF or run.handler == LOGS:
            raise NotHandledError("ran for a local event that triggers another handler")
        if self._adopted:
            self._core.go_along(run)
        handler: Handler = self._implementation.handlers[run.handler]
        return handler

    def _message(self, run: HandlerRun, trigger: MessageTrigger) -> tuple[Handler, int, Message]:
        """Return the handler for a message, the sender, and the decoded message. Raises NotHandledError if no handler
        matches.
        """
        try:
            sender, sequence, message = decoded(run.input)
        except MalformedDatagramError as malformed:
            raise NotHandledError(f"handled a datagram that it must drop: {malformed.reason}") from None
        if type(message) in CARRY_A_BLOCK:
            self._blocks.add_from(message)
        if reason := why_not_handled(self._header.agent_id, self._header.roster, sender, message):
            raise NotHandledError(f"handled a datagram that it must drop: {reason}")
        name, by, number = trigger.message, trigger.sender, trigger.sequence
        if name != message.NAME or by != sender or number != sequence:
            raise NotHandledError(
                f"recorded {name[:60]} {number} from agent {by}, but the datagram is {message.NAME} {sequence} from "
                f"agent {sender}"
            )
        handler: Handler = self._on_message[type(message)]
        if handler.name != run.handler:
            raise AnotherHandlerError(run, handler)
        return handler, sender, message

    def _timer(self, line: int, run: HandlerRun, name: str, now: float) -> Handler:
        timer = self._timers.get(name)
        if timer is None or timer.deadline is None:
            raise NotHandledError(f"ran at the expiry of the {name[:60]} timer, which was not running")
        early = timer.deadline - now
        timer.stop()
        if early > self._header.early_s:
            raise NotHandledError(f"ran {early:.3g} s before the {name} timer expired")
        self.expiries.append(RecordedTimerExpiry(line, run.t, run.handler, name, -early / self._header.rate))
        handler: Handler = self._implementation.on_timer[name]
        return handler

    def _event(self, record: RecordedBytes | None, event_id: int) -> tuple[Any, ...]:
        try:
            event = event_of(record)
        except MalformedEventsError as malformed:
            raise NotHandledError(f"logged an invalid event: {malformed}") from None
        if event.event_id != event_id:
            raise NotHandledError(f"recorded the event {event_id}, but logged {event.event_id}")
        if event.encoded_bytes > (largest := self._header.settings.max_event_bytes):
            raise NotHandledError(
                f"logged an event of {event.encoded_bytes} bytes, more than max_event_bytes {largest}"
            )
        return (event,)

    def _boot(self, run: HandlerRun) -> None:
        """Load the blocks that the agent had on its disk into the reference, before the first handler run."""
        if self._began:
            raise NotHandledError("booted after other steps; a boot must be the first step")
        try:
            left = list(stored_blocks(run.input))
        except ValueError:
            raise NotHandledError("booted from an invalid store") from None
        places: dict[str, list[Block]] = {"chain+": [], "deque+": [], "stack+": []}
        changes = iter(run.changes)
        completed = []
        for operation, block_hash in changes:
            if operation == "complete":
                completed.append(bytes.fromhex(block_hash))
                continue
            if not left or operation not in places:
                break
            block = left.pop(0)
            self._blocks.add(block)
            places[operation].append(block)
            if not left:
                break
        self._core.restore(completed, *places.values())

    # Comparison

    def _differs(self, run: HandlerRun, handler: Handler, branch: str, may_touch_timers: bool) -> bool:
        core = self._core
        if (run.branch != branch and branch_is_known(run)) or run.changes != core.changes:
            return True
        if (run.sent or core.outbox) and not core.has_sent(run.sent):
            return True
        if self._parts.timers and (run.started or {}) != core.started and timers_are_known(run):
            return True
        has_tally = branch in COUNTING and run.handler in self._parts.tallying
        if has_tally and run.tally != self._implementation.tally_of(core, handler) and tally_is_known(run):
            return True
        state = run.state
        if state is self._state and not (may_touch_timers or run.changes or core.triggered):
            return state.reconciling != core.reconcile_in_progress
        self._state = state
        return (
            state.top != self._top_in_hex()
            or state.chain != len(core.chain)
            or state.deque != len(core.blocks_to_be_committed)
            or state.stack != len(core.reconcile_stack)
            or state.reconciling != core.reconcile_in_progress
            or state.idle != core.idle
        )

    def _top_in_hex(self) -> str:
        top = self._core.chain.top_chain_hash
        if top is not self._top:
            self._top, self._top_hex = top, top.hex()
        return self._top_hex

    def _expected(self, run: HandlerRun, handler: Handler, branch: str) -> HandlerRun:
        core = self._core
        state = StateSummary(
            len(core.chain),
            len(core.blocks_to_be_committed),
            len(core.reconcile_stack),
            core.reconcile_in_progress,
            core.idle,
            self._top_in_hex(),
        )
        changes, sent = list(core.changes), core.sent_in_full()
        taken = branch if branch_is_known(run) else run.branch
        expected = HandlerRun(run.t, handler.name, handler.algorithm, run.trigger, taken, changes, sent, state)
        has_tally = branch in COUNTING and run.handler in self._parts.tallying and tally_is_known(run)
        expected.started = dict(core.started) if self._parts.timers and timers_are_known(run) else run.started
        expected.tally = self._implementation.tally_of(core, handler) if has_tally else run.tally
        return expected

    def _adopt(self, line: int, run: HandlerRun, before: StateBeforeStep | None) -> None:
        """Replace the state of the reference by the state that the agent recorded."""
        self._adopted = True
        self._state = None
        try:
            self._core.undo(before)
            self._core.adopt(run, self._blocks)
        except NotOnRecordError as error:
            self.lost = f"after trace line {line} agent {self._header.agent_id} cannot be followed: {error}"
        self._none_ends_before = self._soonest_end()

    def _differ(self, line: int, at_s: float, handler: str, what: str) -> None:
        self.deviations.append(StepDeviation(self._header.agent_id, line, at_s, handler, what))


def _differ_only_in_idle(run: HandlerRun, expected: HandlerRun) -> bool:
    alike = replace(expected, started=run.started if not expected.started and not run.started else expected.started)
    alike.state = replace(expected.state, idle=run.state.idle)
    return replace(alike, input=run.input, sealed=run.sealed) == run


def _triggered_by(run: HandlerRun) -> str | None:
    """Return the handler that triggered this run by a local event. Return None if the run has a different trigger."""
    return run.trigger.handler if isinstance(run.trigger, LocalTrigger) else None
