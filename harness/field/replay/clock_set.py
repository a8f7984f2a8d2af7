"""Whether the agent's clock was set while a timer ran: no timer ends then when its record says that it should.

The messages between it and another show by how much their clocks differ, up to the time that a message takes. If that
jumps by the same with most others, it was this agent's clock that was set, and not the others'.
"""

from functools import cached_property
from statistics import median

from harness.field.replay.agent_record import Record
from harness.field.replay.peer_messages import Exchanges

WITHIN = 200
"""So many lines before and after are looked at."""
MESSAGES = 3
"""With one agent, before and after: of so many the median is taken."""
LEAST_S = 1.0
"""A jump by less is none."""


class ClockSet:
    """Reads the records of the others when it is first asked."""

    def __init__(self, record: Record) -> None:
        self._record = record

    def near(self, position: int) -> str | None:
        """By how much it was set around this entry, as "its clock was set by +30.0 s"; None if nothing shows that."""
        if self._record.beside.record is not None:
            return None  # the agents of a run share one clock
        jumps = [_largest_jump(differences, position) for differences in self._differences]
        known = [jump for jump in jumps if jump is not None]
        least_s = max(LEAST_S, self._record.header.late_s)
        by_s = median(known) if known else 0.0
        agree = sum(abs(jump - by_s) <= least_s for jump in known)
        if abs(by_s) < least_s or 2 * agree <= len(known):
            return None
        return f"its clock was set by {by_s:+.1f} s, as its messages show,"

    @cached_property
    def _differences(self) -> list[list[tuple[int, float]]]:
        """With each other agent: at which entry, and by how much, our clock shows more than its."""
        own = self._record.agent_id
        differences = []
        for agent_id, trace in self._record.beside.traces.items():
            if agent_id == own:
                continue
            with_it = []
            for position, delivery in Exchanges(self._record, trace):
                later_s = delivery.received_s - delivery.sent_s
                with_it.append((position, -later_s if delivery.sender == own else later_s))
            differences.append(with_it)
        return differences


def _largest_jump(differences: list[tuple[int, float]], position: int) -> float | None:
    """Of what a clock shows more than another, around an entry; None if there are too few messages."""
    near = [more for at, more in differences if abs(at - position) <= WITHIN]
    jumps = (
        median(near[number : number + MESSAGES]) - median(near[number - MESSAGES : number])
        for number in range(MESSAGES, len(near) - MESSAGES + 1)
    )
    return max(jumps, key=abs, default=None)
