"""What virtual time did, beside what is on record: the same steps, and the same chains at the end?"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from harness.archive.traces import Trace
from harness.field.reconstruct._rehearsal import Rehearsal, same_sent
from harness.field.reconstruct._timetable import Timetable
from harness.run.simulate import Simulated
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger


@dataclass(frozen=True)
class FirstDifference:
    """Where virtual time does not do what is on record: agent, mission second of the reconstruction, line of its trace.

    `line` is None if the record has nothing more there. `recorded` and `played` are in words.
    """

    agent_id: int
    at_s: float
    line: int | None
    handler: str
    recorded: str
    played: str

    @property
    def sentence(self) -> str:
        where = f"trace line {self.line}" if self.line else "after the end of its trace"
        return (
            f"agent {self.agent_id} at {self.at_s:.3f} s, {where}, {self.handler}: "
            f"the record says it {self.recorded}, and in virtual time it {self.played}"
        )


Step = tuple[float, int | None, HandlerRun]
"""Mission second, line of the trace, and what ran."""


def first_difference(
    table: Timetable, rehearsals: Mapping[int, Rehearsal], simulated: Simulated
) -> FirstDifference | None:
    """The first in mission time; None if every step that had an effect is the same."""
    differences = []
    for agent_id in rehearsals:
        recorded = [*_effective(_recorded(table, agent_id))]
        played = [*_effective(_played(simulated.evidence.traces.get(agent_id)))]
        if difference := _compare(agent_id, recorded, played):
            differences.append(difference)
    return min(differences, key=lambda difference: difference.at_s, default=None)


def _recorded(table: Timetable, agent_id: int) -> Iterator[Step]:
    for happening in table.happenings[agent_id]:
        for run in happening.played.input.runs:
            yield happening.at_s, happening.played.input.line, run


def _played(trace: Trace | None) -> Iterator[Step]:
    for run in trace.runs if trace else ():
        yield run.t, None, run


def _effective(steps: Iterable[Step]) -> Iterator[Step]:
    """Without messages of which nothing came but a tally."""
    return (
        step for step in steps if step[2].changes or step[2].sent or not isinstance(step[2].trigger, MessageTrigger)
    )


def _compare(agent_id: int, recorded: Sequence[Step], played: Sequence[Step]) -> FirstDifference | None:
    for ours, theirs in zip_longest(played, recorded):
        if ours is None or theirs is None or not _same(ours[2], theirs[2]):
            at_s = min(step[0] for step in (ours, theirs) if step is not None)
            line = theirs[1] if theirs else None
            handler = (theirs or ours)[2].handler
            return FirstDifference(agent_id, at_s, line, handler, _in_words(theirs), _in_words(ours))
    return None


def _same(ours: HandlerRun, theirs: HandlerRun) -> bool:
    return ours.handler == theirs.handler and ours.changes == theirs.changes and same_sent(ours.sent, theirs.sent)


def _in_words(step: Step | None) -> str:
    if step is None:
        return "did nothing more"
    run = step[2]
    changed = ", ".join(f"{operation} {block[:12]}" for operation, block in run.changes)
    sent = ", ".join(sent.message for sent in run.sent)
    words = [f"ran {run.handler} ({run.branch[:60]})", changed and f"changed {changed}", sent and f"sent {sent}"]
    return ", ".join(filter(None, words))
