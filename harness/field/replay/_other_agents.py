"""What the other agents did at the moment at which a record stands, if their records are there."""

from bisect import bisect_right
from collections.abc import Iterator
from functools import cached_property
from itertools import accumulate

from rich.text import Text

from harness.archive.traces import Trace
from harness.field.reconstruct._clock_offsets import Line, estimate
from harness.field.replay._agent_record import Record
from harness.field.replay._peer_messages import Exchanges
from harness.field.replay._player import Player
from harness.present.text import shown
from ucp.clock import MICROSECONDS
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger

NEAR_S = 2.0
"""Steps of others so near to the moment are shown, in mission seconds before and after."""
STEPS_SHOWN = 2
"""Before, and after; besides what has to do with the step."""


class Others:
    """Reads their records when it is first asked.

    The agents of a run share one clock. What came home from the field has clocks of its own, which the messages between
    two agents tell apart.
    """

    def __init__(self, record: Record) -> None:
        self._record = record

    @cached_property
    def _traces(self) -> dict[int, "_Other"]:
        record = self._record
        others = {agent_id: trace for agent_id, trace in record.beside.traces.items() if agent_id != record.agent_id}
        return {agent_id: _Other(record, trace) for agent_id, trace in others.items()}

    def at(self, player: Player) -> Iterator[Text]:
        """What each did around this moment, what it held then, and what it has to do with this step."""
        entry = player.entry
        now = entry.what.t if entry else 0.0
        top = player.state.chain.top_chain_hash.hex()
        run = entry.what if entry and isinstance(entry.what, HandlerRun) else None
        if not self._traces:
            yield shown("  no records of other agents in this directory", style="yellow")
        for agent_id in sorted({*self._record.header.roster, *self._traces} - {self._record.agent_id}):
            other = self._traces.get(agent_id)
            if other is None:
                yield shown(f"  agent {agent_id}: no record in this directory", style="dim")
                continue
            yield shown(f"  agent {agent_id}: ", style="bold").append(shown(other.held(now, top), "not bold"))
            if run is not None:
                yield from other.has_to_do_with(agent_id, run)
            for number in other.near(now):
                line, theirs = other.runs[number]
                after_s = other.clock.at(theirs.t) - now
                words = (
                    f"{after_s:+8.3f} s  line {line}: A{theirs.algorithm} {theirs.handler[:40]}: {theirs.branch[:40]}"
                )
                yield shown(f"    {words}", style="dim")


class _Other:
    """`clock` is what its clock shows beside ours."""

    def __init__(self, record: Record, trace: Trace) -> None:
        self._exchanges = Exchanges(record, trace)
        self.runs = self._exchanges.runs
        self.clock = Line() if record.beside.record is not None else self._estimated(record, trace)
        self._times = [*accumulate((self.clock.at(run.t) for _, run in self.runs), max)]

    def _estimated(self, record: Record, trace: Trace) -> Line:
        own, other = record.agent_id, trace.header.agent_id
        deliveries = [exchange.delivery for exchange in self._exchanges]
        if not deliveries:
            return Line(_ahead_s(record.trace, trace))
        clocks = estimate((own, other), deliveries)
        return clocks[other].after(clocks[own].inverse())

    def near(self, now: float) -> range:
        """Its last runs before this moment, and the next."""
        first, until = (bisect_right(self._times, now + seconds) for seconds in (-NEAR_S, NEAR_S))
        middle = bisect_right(self._times, now)
        return range(max(first, middle - STEPS_SHOWN), min(until, middle + STEPS_SHOWN))

    def held(self, now: float, top: str) -> str:
        """What it held."""
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

    def has_to_do_with(self, theirs: int, run: HandlerRun) -> Iterator[Text]:
        """Where it sent what triggered our run, and what it made of what our run sent."""
        trigger = run.trigger
        if isinstance(trigger, MessageTrigger) and trigger.sender == theirs:
            numbers = self._exchanges.that_sent(trigger.message, trigger.sequence)
            for line, sending in self._nearest(numbers, run.t):
                yield shown(
                    f"    sent it at line {line}, by {sending.handler[:40]}: {sending.branch[:40]}", style="green"
                )
        for message in run.sent:
            heard = self._nearest(self._exchanges.that_heard(message.message, message.seq), run.t)
            for line, hearing in heard:
                words = f"heard {message.message[:60]} {message.seq} at line {line}: {hearing.branch[:40]}"
                yield shown(f"    {words}", style="green")
            if not heard:
                yield shown(f"    has no line for {message.message[:60]} {message.seq}", style="yellow")

    def _nearest(self, numbers: list[int], at_s: float) -> list[tuple[int, HandlerRun]]:
        """The sequence numbers of a new life begin anew: it is the run nearest in time."""
        runs = (self.runs[number] for number in numbers)
        return sorted(runs, key=lambda numbered: abs(self.clock.at(numbered[1].t) - at_s))[:1]


def _ahead_s(ours: Trace, theirs: Trace) -> float:
    """How much more their mission clock shows than ours, by the moments at which they began."""
    own, other = (trace.header.clock.get("epoch_us") for trace in (ours, theirs))
    speedup = ours.header.clock.get("speedup", 1.0)
    if not (isinstance(own, int) and isinstance(other, int) and isinstance(speedup, int | float)):
        return 0.0
    return (own - other) / MICROSECONDS * speedup
