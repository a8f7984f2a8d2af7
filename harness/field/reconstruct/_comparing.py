"""Compare simulated agents with the records. First simulate each agent alone, and then the whole flight."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from harness.archive.traces import Trace
from harness.checker.judgement import agents
from harness.checker.steps.trace_header import CheckedHeader
from harness.field.ingest import Flight
from harness.field.reconstruct._agent_inputs import RecordedInput, inputs_by_incarnation
from harness.field.reconstruct._inferring import infer
from harness.field.reconstruct._judged_trace import JudgedTrace
from harness.field.reconstruct._known_mission import OtherRecords
from harness.field.reconstruct._rehearsal import (
    Incarnations,
    ProtocolDeviation,
    SoloSimulation,
    ToleratedDeviations,
    rehearse,
    same_sent,
)
from harness.field.reconstruct._timetable import InputTimetable
from harness.field.replay import PERHAPS
from harness.play.core_version import edited_files
from harness.run.simulate import Simulated
from ucp.quirks import QUIRKS
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger


@dataclass(frozen=True)
class FirstDifference:
    """The first step at which the simulation differs from a record."""

    agent_id: int
    at_s: float
    """The mission second in the reconstructed scenario."""
    line: int | None
    """The line number in the trace, or None if the record has no further step."""
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


PlayedStep = tuple[float, int | None, HandlerRun]
"""A simulated step: mission second, line of the trace, and handler run."""


def first_difference(
    table: InputTimetable, rehearsals: Mapping[int, SoloSimulation], simulated: Simulated
) -> FirstDifference | None:
    """Return the difference with the earliest mission time. Return None if all steps that have an effect are equal."""
    differences = []
    for agent_id in rehearsals:
        recorded = [*_effective(_recorded(table, agent_id))]
        played = [*_effective(_played(simulated.evidence.traces.get(agent_id)))]
        if difference := _compare(agent_id, recorded, played):
            differences.append(difference)
    return min(differences, key=lambda difference: difference.at_s, default=None)


def _recorded(table: InputTimetable, agent_id: int) -> Iterator[PlayedStep]:
    for timed_input in table.inputs[agent_id]:
        for run in timed_input.played.input.runs:
            yield timed_input.at_s, timed_input.played.input.line, run


def _played(trace: Trace | None) -> Iterator[PlayedStep]:
    for run in trace.runs if trace else ():
        yield run.t, None, run


def _effective(steps: Iterable[PlayedStep]) -> Iterator[PlayedStep]:
    """Yield the steps that have an effect. A step has no effect if its message only changed a vote count."""
    return (
        step for step in steps if step[2].changes or step[2].sent or not isinstance(step[2].trigger, MessageTrigger)
    )


def _compare(agent_id: int, recorded: Sequence[PlayedStep], played: Sequence[PlayedStep]) -> FirstDifference | None:
    for ours, theirs in zip_longest(played, recorded):
        if ours is None or theirs is None or not _same(ours[2], theirs[2]):
            at_s = min(step[0] for step in (ours, theirs) if step is not None)
            line = theirs[1] if theirs else None
            handler = (theirs or ours)[2].handler
            return FirstDifference(agent_id, at_s, line, handler, _in_words(theirs), _in_words(ours))
    return None


def _same(ours: HandlerRun, theirs: HandlerRun) -> bool:
    return ours.handler == theirs.handler and ours.changes == theirs.changes and same_sent(ours.sent, theirs.sent)


def _in_words(step: PlayedStep | None) -> str:
    if step is None:
        return "did nothing more"
    run = step[2]
    changed = ", ".join(f"{operation} {block[:12]}" for operation, block in run.changes)
    sent = ", ".join(sent.message for sent in run.sent)
    words = [f"ran {run.handler} ({run.branch[:60]})", changed and f"changed {changed}", sent and f"sent {sent}"]
    return ", ".join(filter(None, words))


EARLY_TIMERS = "timers of agent {agent_id} expired too early by its clock, as if the clock had been set back"


RecordedInputs = Sequence[Sequence[RecordedInput]]
"""The recorded inputs of each incarnation."""


class SoloSimulations:
    """The simulations of single agents. Each agent is simulated alone, with its recorded inputs."""

    def __init__(self, flight: Flight, other_records: OtherRecords) -> None:
        self.rehearsals: dict[int, SoloSimulation] = {}
        """The simulations of all agents that can be simulated."""
        self.why: dict[int, str] = {}
        """The reasons why some simulations are incomplete."""
        self._flight = flight
        self._other_records = other_records
        self._by_captures: list[int] = []
        self._remarks: list[str] = []

    @property
    def remarks(self) -> list[str]:
        """Sentences about the assumptions and findings of the reconstruction."""
        if not self._by_captures:
            return self._remarks
        which = agents(self._by_captures)
        inferred = f"the inputs of {which} come from captures and blocks; the expiry of its timers is inferred"
        return [*self._remarks, inferred]

    def rehearse(self, header: CheckedHeader) -> None:
        """Simulate an agent with the inputs in its trace, and store the simulation in `rehearsals`. If the trace is
        missing, or the simulated agent does not reach the exported chain although it never deviates, also simulate the
        agent with the inputs in its vehicle's capture. In this case, store the simulation with more inputs.
        """
        agent_id = header.agent_id
        rehearsal = self._by_trace(header) if agent_id in self._flight.traces else None
        if rehearsal is None or not rehearsal.deviation:
            rehearsal = self._by_capture(header, rehearsal)
        if rehearsal is not None and (rehearsal.played or rehearsal.deviation is None):
            self.rehearsals[agent_id] = rehearsal

    def _by_trace(self, header: CheckedHeader) -> SoloSimulation:
        agent_id = header.agent_id
        incarnations, problem = inputs_by_incarnation(self._flight.traces[agent_id], header, self._other_records)
        whole = rehearse(header, incarnations)
        if problem is not None and whole.deviation is None:
            whole.truncated = True
            self.why[agent_id] = f"can be played only in part: {problem}"
        if problem is not None or (whole.deviation is None and whole.matches_exactly and self._leads_to_export(whole)):
            return whole
        judged = JudgedTrace(self._flight, agent_id)
        if judged.deviations:
            return self._explain_deviations(header, incarnations, judged, whole)
        if whole.deviation is None and self._leads_to_export(whole):
            return whole
        if (at := whole.deviation) is not None and not judged.lost and (edited := edited_files()):
            self.why[agent_id] = (
                f"is played up to trace line {at.line}: its record follows the protocol there, but the agent core was "
                f"edited ({', '.join(edited)})"
            )
            return whole
        return self._play_around_lost_lines(header, incarnations, judged, whole)

    def _leads_to_export(self, rehearsal: SoloSimulation) -> bool:
        export = self._flight.exports.get(rehearsal.agent_id)
        return export is None or rehearsal.chain == list(export.chain_of_block_hashes)

    def _explain_deviations(
        self, header: CheckedHeader, incarnations: RecordedInputs, judged: JudgedTrace, whole: SoloSimulation
    ) -> SoloSimulation:
        """Explain the deviations of an agent by a known mistake (quirk), if possible. Otherwise simulate the agent up
        to the first deviation.
        """
        agent_id, finding = header.agent_id, judged.first_finding
        parts: Incarnations = judged.with_known_states(incarnations) if judged.lost else incarnations
        in_parts = rehearse(header, parts) if judged.lost else whole
        if in_parts.deviation is None:
            named = self._explain_by_quirk(header, incarnations, whole.deviation) if whole.deviation else None
            if named is not None:
                return named
            self._remarks.append(f"agent {agent_id} deviates without effect: {finding}")
            self._note_lost(in_parts, judged)
            return in_parts
        explained = self._explain_by_quirk(header, parts, in_parts.deviation) or self._explain_by_tolerance(
            header, incarnations
        )
        if explained is not None:
            self._note_lost(explained, judged)
            return explained
        line = in_parts.deviation.line
        self.why[agent_id] = f"deviates from the protocol, and is played up to trace line {line}: {finding}"
        return in_parts

    def _play_around_lost_lines(
        self, header: CheckedHeader, incarnations: RecordedInputs, judged: JudgedTrace, whole: SoloSimulation
    ) -> SoloSimulation:
        """Simulate an agent whose recorded steps follow the protocol. Guessed inputs replace the inputs on lost lines,
        if possible.
        """
        agent_id = header.agent_id
        early = (
            rehearse(header, incarnations, tolerance=ToleratedDeviations(early_timers=True))
            if whole.deviation
            else whole
        )
        if early.deviation is None and self._leads_to_export(early):
            self._remarks.append(EARLY_TIMERS.format(agent_id=agent_id))
            return early
        around = rehearse(header, judged.with_known_states(incarnations))
        if whole.deviation is not None:
            self._name_alternative(header, incarnations, judged, whole.deviation)
        if around.deviation is None and around.stopped is None:
            self._note_lost(around, judged)
            return around
        best = max((whole, around), key=lambda rehearsal: len(rehearsal.played) - rehearsal.inferred)
        why = best.stopped or next(iter(judged.lost), "the inputs after it lead to another course than recorded")
        best.truncated = True
        last = max((played.input.line for played in best.played), default=1)
        self.why[agent_id] = f"is played up to trace line {last}, and the lost inputs cannot be inferred: {why}"
        return best

    def _name_alternative(
        self, header: CheckedHeader, incarnations: RecordedInputs, judged: JudgedTrace, at: ProtocolDeviation
    ) -> None:
        """Add a remark if damage to a single line explains the trace as well as a known mistake (quirk) does."""
        doubt = next((sentence for sentence in judged.lost if f" {PERHAPS} " in sentence), None)
        if doubt is None:
            return
        names = [
            quirk.name
            for quirk in QUIRKS.values()
            if not (quirk.chance or at.algorithms.isdisjoint(quirk.algorithms))
            and (rehearsal := rehearse(header, incarnations, {quirk.name: True})).deviation is None
            and rehearsal.stopped is None
        ]
        if names:
            which = " or ".join(names)
            self._remarks.append(f"either agent {header.agent_id} behaves as with {which}, or {doubt}")

    def _note_lost(self, rehearsal: SoloSimulation, judged: JudgedTrace) -> None:
        if rehearsal.stopped is not None:
            self.why[rehearsal.agent_id] = f"is played in part, and lost inputs cannot be inferred: {rehearsal.stopped}"
        elif rehearsal.inferred:
            why = next(iter(judged.lost), "its trace ends before its export")
            self._remarks.append(
                f"{rehearsal.inferred} inputs of agent {rehearsal.agent_id} are inferred from its later blocks, "
                f"because lines of its trace are not on record: {why}"
            )

    def _by_capture(self, header: CheckedHeader, by_trace: SoloSimulation | None) -> SoloSimulation | None:
        """Return the simulation that explains more inputs: the given simulation `by_trace`, or a simulation with the
        packet capture. Return None if neither exists.
        """
        agent_id = header.agent_id
        export, capture = self._flight.exports.get(agent_id), self._other_records.captures.get(agent_id)
        if capture is None or export is None or (by_trace and by_trace.chain == list(export.chain_of_block_hashes)):
            return by_trace
        inferred = infer(header, capture, self._other_records.events(agent_id))
        by_capture = rehearse(header, inferred.incarnations)
        if by_trace is not None and len(by_trace.played) >= len(by_capture.played):
            return by_trace
        self.why.pop(agent_id, None)
        if inferred.problem:
            self.why[agent_id] = inferred.problem
            by_capture.truncated = True
        self._by_captures.append(agent_id)
        return by_capture

    def _explain_by_quirk(
        self, header: CheckedHeader, incarnations: Incarnations, at: ProtocolDeviation
    ) -> SoloSimulation | None:
        """Return a simulation in which a known mistake (quirk) explains the whole record. Return None if no known
        mistake does.

        Quirks of the handlers that ran at the deviation are tried first.
        """
        explaining: dict[str, SoloSimulation] = {}
        deterministic = [quirk for quirk in QUIRKS.values() if not quirk.chance]
        for quirk in sorted(deterministic, key=lambda quirk: at.algorithms.isdisjoint(quirk.algorithms)):
            rehearsal = rehearse(header, incarnations, {quirk.name: True})
            if rehearsal.deviation is None and rehearsal.stopped is None:
                explaining[quirk.name] = rehearsal
        exact = [name for name, rehearsal in explaining.items() if rehearsal.matches_exactly]
        names = exact or [*explaining]
        if not names:
            return None
        agent = f"agent {header.agent_id}"
        if len(names) == 1:
            self._remarks.append(f"{agent} behaves as with {names[0]}: {QUIRKS[names[0]].sentence}")
            self._remarks.append(
                f"{names[0]} is the only one of {len(deterministic)} known mistakes that explains {agent}"
            )
        else:
            self._remarks.append(
                f"{agent} deviates, and {len(names)} known mistakes explain its record equally well: "
                f"{', '.join(names)}; the scenario has the first"
            )
        return explaining[names[0]]

    def _explain_by_tolerance(self, header: CheckedHeader, incarnations: Incarnations) -> SoloSimulation | None:
        """Simulate an agent that may ignore messages or let timers expire early. Return the simulation if it explains
        the whole record. Otherwise return None.
        """
        agent = f"agent {header.agent_id}"
        ignoring = rehearse(header, incarnations, tolerance=ToleratedDeviations(ignoring=True))
        if ignoring.deviation is None:
            first = ignoring.ignored[0]
            count = f"{len(ignoring.ignored)} messages" if len(ignoring.ignored) > 1 else "a message"
            self._remarks.append(
                f"{agent} did not react to {count}, the first on trace line {first.line} ({first.runs[0].handler}): in "
                "the scenario these messages are lost"
            )
            return ignoring
        early = rehearse(header, incarnations, tolerance=ToleratedDeviations(early_timers=True))
        if early.deviation is None:
            self._remarks.append(EARLY_TIMERS.format(agent_id=header.agent_id))
            return early
        return None
