"""Show the steps of the other agents near the current moment of a replay, as far as their records exist."""

from bisect import bisect_right
from collections.abc import Iterator
from functools import cached_property
from itertools import accumulate

from rich.text import Text

from harness.archive.traces import Trace
from harness.field.replay._agent_record import RecordedTrace
from harness.field.replay._peer_messages import ClockLine, PeerMessages, estimate
from harness.field.replay._player import RecordPlayer
from harness.present.text import shown
from ucp.clock import MICROSECONDS
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger

NEAR_S = 2.0
"""Maximum number of mission seconds between the current moment and a shown step."""
STEPS_SHOWN = 2
"""Maximum number of steps shown before the current moment, and after it. Steps that are related to the current step are
shown as well.
"""


class OtherAgents:
    """The records of the agents that are not replayed. Each record is read when it is first used.

    The agents of a run share one clock. In the field, agents have separate clocks. The offset between two clocks is
    computed from the messages between the two agents.
    """

    def __init__(self, record: RecordedTrace) -> None:
        self._record = record

    @cached_property
    def _traces(self) -> dict[int, "_OtherAgent"]:
        record = self._record
        others = {agent_id: trace for agent_id, trace in record.flight.traces.items() if agent_id != record.agent_id}
        return {agent_id: _OtherAgent(record, trace) for agent_id, trace in others.items()}

    def at(self, player: RecordPlayer) -> Iterator[Text]:
        """Yield text about each other agent: its steps near this moment, its state, and the messages that connect it
        with the current step.
        """
        entry = player.entry
        now = entry.content.t if entry else 0.0
        top = player.state.chain.top_chain_hash.hex()
        run = entry.content if entry and isinstance(entry.content, HandlerRun) else None
        if not self._traces:
            yield shown("  no records of other agents in this directory", style="yellow")
        for agent_id in sorted({*self._record.header.roster, *self._traces} - {self._record.agent_id}):
            other = self._traces.get(agent_id)
            if other is None:
                yield shown(f"  agent {agent_id}: no record in this directory", style="dim")
                continue
            yield shown(f"  agent {agent_id}: ", style="bold").append(shown(other.state_text(now, top), "not bold"))
            if run is not None:
                yield from other.related_lines(agent_id, run)
            for number in other.runs_near(now):
                line, their_run = other.runs[number]
                after_s = other.clock.at(their_run.t) - now
                handler = f"A{their_run.algorithm} {their_run.handler[:40]}: {their_run.branch[:40]}"
                words = f"{after_s:+8.3f} s  line {line}: {handler}"
                yield shown(f"    {words}", style="dim")


class _OtherAgent:
    """The trace of an agent that is not replayed. `clock` converts between the clock of this agent and the clock of the
    replayed agent.
    """

    def __init__(self, record: RecordedTrace, trace: Trace) -> None:
        self._messages = PeerMessages(record, trace)
        self.runs = self._messages.runs
        self.clock = ClockLine() if record.flight.record is not None else self._estimated(record, trace)
        self._times = [*accumulate((self.clock.at(run.t) for _, run in self.runs), max)]

    def _estimated(self, record: RecordedTrace, trace: Trace) -> ClockLine:
        own, other = record.agent_id, trace.header.agent_id
        deliveries = [message.delivery for message in self._messages]
        if not deliveries:
            return ClockLine(_ahead_s(record.trace, trace))
        clocks = estimate((own, other), deliveries)
        return clocks[other].after(clocks[own].inverse())

    def runs_near(self, now: float) -> range:
        """Return the positions of the agent's last handler runs before this moment, and of its first handler runs after
        it.
        """
        first, until = (bisect_right(self._times, now + seconds) for seconds in (-NEAR_S, NEAR_S))
        middle = bisect_right(self._times, now)
        return range(max(first, middle - STEPS_SHOWN), min(until, middle + STEPS_SHOWN))

    def state_text(self, now: float, top: str) -> str:
        """Describe the state of the agent at this moment."""
        number = bisect_right(self._times, now) - 1
        if number < 0:
            return "nothing yet"
        line, run = self.runs[number]
        state = run.state
        chain = "the same chain" if state.top == top else f"another chain of {state.chain}"
        doing = "reconciling" if state.reconciling else "idle" if state.idle else "voting"
        return (
            f"{chain}, deque {state.deque}, stack {state.stack}, {doing} since line {line}, {run.t:.3f} s of its clock"
        )

    def related_lines(self, their_run: int, run: HandlerRun) -> Iterator[Text]:
        """Yield text about the lines of the other agent that are related to the current step: the line that sent the
        message of the current step, and the lines that received messages from the current step. If the trace of the
        other agent does not contain the reception of a message, a text states this.
        """
        trigger = run.trigger
        if isinstance(trigger, MessageTrigger) and trigger.sender == their_run:
            numbers = self._messages.runs_that_sent(trigger.message, trigger.sequence)
            for line, sending in self._nearest(numbers, run.t):
                yield shown(
                    f"    sent it at line {line}, by {sending.handler[:40]}: {sending.branch[:40]}", style="green"
                )
        for message in run.sent:
            receipts = self._nearest(self._messages.runs_that_received(message.message, message.seq), run.t)
            for line, receipt in receipts:
                words = f"heard {message.message[:60]} {message.seq} at line {line}: {receipt.branch[:40]}"
                yield shown(f"    {words}", style="green")
            if not receipts:
                yield shown(f"    has no line for {message.message[:60]} {message.seq}", style="yellow")

    def _nearest(self, numbers: list[int], at_s: float) -> list[tuple[int, HandlerRun]]:
        """Return the handler run that is nearest in time to the current step, in a list. The list is empty if there is
        no handler run. Several handler runs may match a message, because sequence numbers repeat after restarts.
        """
        runs = (self.runs[number] for number in numbers)
        return sorted(runs, key=lambda numbered: abs(self.clock.at(numbered[1].t) - at_s))[:1]


def _ahead_s(our_trace: Trace, their_run: Trace) -> float:
    """Return the difference between the mission clocks of two agents in seconds, from the start times in both
    traces.
    """
    own, other = (trace.header.clock.get("epoch_us") for trace in (our_trace, their_run))
    speedup = our_trace.header.clock.get("speedup", 1.0)
    if not (isinstance(own, int) and isinstance(other, int) and isinstance(speedup, int | float)):
        return 0.0
    return (own - other) / MICROSECONDS * speedup
