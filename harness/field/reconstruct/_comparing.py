"""Compare played agents with their records: each agent alone, and the whole flight."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from harness.archive.traces import Trace
from harness.checker import Evidence, steps
from harness.checker.judgement import agents
from harness.checker.steps.trace_header import CheckedHeader
from harness.field.ingest import Flight
from harness.field.reconstruct._agent_inputs import Input, lives_of
from harness.field.reconstruct._inferring import infer
from harness.field.reconstruct._other_records import Elsewhere
from harness.field.reconstruct._rehearsal import Allowed, Parting, Rehearsal, rehearse, same_sent
from harness.field.reconstruct._timetable import Timetable
from harness.run.simulate import Simulated
from ucp.quirks import QUIRKS
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
            f"agent {self.agent_id} at {self.at_s:.3f} s, {where}, {self.handler}: in the record it {self.recorded}; "
            f"in virtual time it {self.played}"
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


Lives = Sequence[Sequence[Input]]


class Alone:
    """`rehearsals` has every agent that can be played, and `why` says of whom it is not all that came home."""

    def __init__(self, flight: Flight, elsewhere: Elsewhere) -> None:
        self.rehearsals: dict[int, Rehearsal] = {}
        self.why: dict[int, str] = {}
        self._flight = flight
        self._elsewhere = elsewhere
        self._by_captures: list[int] = []
        self._remarks: list[str] = []

    @property
    def remarks(self) -> list[str]:
        """What was assumed, and what was found."""
        if not self._by_captures:
            return self._remarks
        which = agents(self._by_captures)
        inferred = f"the inputs of {which} come from captures and blocks; the expiry of its timers is inferred"
        return [*self._remarks, inferred]

    def rehearse(self, header: CheckedHeader) -> None:
        """By its trace; or, if that does not lead to its export, by its capture if that says more."""
        agent_id = header.agent_id
        rehearsal = self._by_trace(header) if agent_id in self._flight.traces else None
        if rehearsal is None or not rehearsal.parting:
            rehearsal = self._by_capture(header, rehearsal)
        if rehearsal is not None and (rehearsal.played or rehearsal.parting is None):
            self.rehearsals[agent_id] = rehearsal

    def _by_trace(self, header: CheckedHeader) -> Rehearsal:
        agent_id = header.agent_id
        lives, problem = lives_of(self._flight.traces[agent_id], header, self._elsewhere)
        rehearsal = rehearse(header, lives)
        if rehearsal.parting is not None:
            explained = self._with_a_quirk(header, lives, rehearsal.parting)
            rehearsal = explained or self._with_what_is_not_right(header, lives) or rehearsal
        elif not rehearsal.to_the_word and (words := self._judged(agent_id)):
            self._remarks.append(f"agent {agent_id} deviates without effect: {words}")
        if (parting := rehearsal.parting) is not None:
            words = self._judged(agent_id) or f"trace line {parting.line}, t={parting.at_s:g} s: it {parting.what}"
            self.why[agent_id] = f"deviates from the protocol, and is played up to trace line {parting.line}: {words}"
        elif problem is not None:
            rehearsal.broken_off = True
            self.why[agent_id] = f"can be played only in part: {problem}"
        return rehearsal

    def _by_capture(self, header: CheckedHeader, by_trace: Rehearsal | None) -> Rehearsal | None:
        """The rehearsal that explains more: this one, if it is needed at all."""
        agent_id = header.agent_id
        home, captured = self._flight.exports.get(agent_id), self._elsewhere.captured.get(agent_id)
        if captured is None or home is None or (by_trace and by_trace.chain == list(home.chain_of_block_hashes)):
            return by_trace
        inferred = infer(header, captured, self._elsewhere.events(agent_id))
        by_capture = rehearse(header, inferred.lives)
        if by_trace is not None and len(by_trace.played) >= len(by_capture.played):
            return by_trace
        self.why.pop(agent_id, None)
        if inferred.problem:
            self.why[agent_id] = inferred.problem
            by_capture.broken_off = True
        self._by_captures.append(agent_id)
        return by_capture

    def _with_a_quirk(self, header: CheckedHeader, lives: Lives, at: Parting) -> Rehearsal | None:
        """The rehearsal with a known mistake that explains the whole record, if possible to the word.

        Those of the handlers are tried first that ran where the agent parts from the protocol.
        """
        explaining: dict[str, Rehearsal] = {}
        certain = (quirk for quirk in QUIRKS.values() if not quirk.chance)
        for quirk in sorted(certain, key=lambda quirk: at.algorithms.isdisjoint(quirk.algorithms)):
            rehearsal = rehearse(header, lives, {quirk.name: True})
            if rehearsal.parting is None:
                explaining[quirk.name] = rehearsal
                if rehearsal.to_the_word:
                    break
        if not explaining:
            return None
        name = max(explaining, key=lambda name: explaining[name].to_the_word)
        self._remarks.append(f"agent {header.agent_id} behaves as with {name}: {QUIRKS[name].sentence}")
        return explaining[name]

    def _with_what_is_not_right(self, header: CheckedHeader, lives: Lives) -> Rehearsal | None:
        """The rehearsal of an agent whose mistakes a scenario can do without: its chain comes out all the same."""
        who = f"agent {header.agent_id}"
        ignoring = rehearse(header, lives, allowed=Allowed(ignoring=True))
        if ignoring.parting is None:
            first = ignoring.ignored[0]
            many = f"{len(ignoring.ignored)} messages" if len(ignoring.ignored) > 1 else "a message"
            self._remarks.append(
                f"{who} did not react to {many}, the first on trace line {first.line} ({first.runs[0].handler}): in "
                "the scenario these messages are lost"
            )
            return ignoring
        early = rehearse(header, lives, allowed=Allowed(early_timers=True))
        if early.parting is None:
            self._remarks.append(f"timers of {who} expired too early by its clock, as if the clock had been set back")
            return early
        return None

    def _judged(self, agent_id: int) -> str | None:
        """The first step of the agent that the step judge finds wrong, in its words; None if it finds none."""
        judgement = steps.check(Evidence(self._flight.exports, {agent_id: self._flight.traces[agent_id]}))
        return next((finding.detail for finding in judgement.evidence if finding.agent_id == agent_id), None)
