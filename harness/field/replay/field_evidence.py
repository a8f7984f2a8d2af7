"""Prepare the records of a real flight for the checker. A real flight has no run.json, and trace lines may be missing.

The steps in each trace are judged in the same way as by the command `replay`. The other checks read a trace only up to
the first place at which lines are missing.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from harness.archive.traces import Trace
from harness.checker import Evidence, steps
from harness.checker.judgement import Judgement
from harness.checker.lost_lines import lacking_traces, lost_lines
from harness.checker.steps.deviation import StepDeviation
from harness.errors import FieldError
from harness.field.ingest import Flight
from harness.field.replay._agent_record import RecordedTrace
from harness.field.replay._player import RecordPlayer, ReplayResult
from harness.field.replay._record_search import IngestedRecords


def field_evidence(evidence: Evidence, flight: Flight) -> Evidence:
    """Return the evidence with the traces of this flight. The returned evidence also contains the judgement on the
    steps in these traces.
    """
    results: dict[int, ReplayResult | str] = {}
    traces: dict[int, Trace] = {}
    for agent_id, recorded in flight.traces.items():
        doubtful, file = dict[int, str](), flight.sources.get(agent_id, [Path()])[0]
        try:
            record = RecordedTrace(file, "", recorded, IngestedRecords(flight), [])
            results[agent_id] = RecordPlayer(record).to_end()
            doubtful = record.doubtful_runs
        except FieldError as error:
            results[agent_id] = str(error).removeprefix(f"{file}: ")
        traces[agent_id] = _up_to_loss(recorded, doubtful)
    for agent_id, why in lacking_traces(traces):
        traces[agent_id].problem = traces[agent_id].problem or why
    for agent_id, export in evidence.exports.items():
        trace = traces.get(agent_id)
        if trace is not None and not trace.problem and trace.runs and trace.runs[-1].state.top != export.top_chain_hash:
            trace.problem = "it ends before the export"
    judged = replace(evidence, traces=traces, from_field=True)
    return replace(judged, steps=_judge_steps(judged, results))


def _up_to_loss(trace: Trace, doubtful: Mapping[int, str]) -> Trace:
    """Return the part of a trace before the first missing or doubtful line. The problem of the returned trace is the
    reason why it ends there.
    """
    lost = {**doubtful, **lost_lines(trace)}
    lost |= {gap.position: "lines are damaged" for gap in trace.gaps}
    lost |= dict.fromkeys(trace.jumps, "the clock of the agent was set")
    if trace.cut_off:
        lost.setdefault(len(trace.runs), "it ends in the middle of a line")
    if not lost:
        return replace(trace)
    end = min(lost)
    return Trace(
        trace.header,
        trace.runs[:end],
        [start for start in trace.starts if start <= end],
        [(position, aside) for position, aside in trace.asides if position < end],
        problem=f"{lost[end]}; the part before is read",
    )


def _judge_steps(evidence: Evidence, results: Mapping[int, ReplayResult | str]) -> Judgement:
    """Return the judgement on the results of all replays. If a result is a text, the text is the reason why the trace
    of this agent cannot be judged.
    """
    deviations: list[StepDeviation] = []
    judged, unjudged, lost = 0, 0, list[str]()
    for agent_id, result in results.items():
        if isinstance(result, str):
            lost.append(f"the trace of agent {agent_id} cannot be judged: {result}")
            continue
        deviations += result.deviations
        judged, unjudged = judged + result.steps, unjudged + result.unjudged
        lost += [f"agent {agent_id}: {sentence}" for sentence in result.lost]
    if deviations:
        return steps.deviates(evidence, deviations, judged, [])
    if not lost:
        lost += [
            f"agent {trace.header.agent_id}: {trace.problem}" for trace in evidence.traces.values() if trace.problem
        ]
    untraced = sorted({*(evidence.roster or ()), *evidence.exports} - {*results})
    lost += [f"there is no trace of agent {agent_id}" for agent_id in untraced]
    if lost or not judged:
        found = f"{judged} handler runs follow Algorithms 1 to 20, and {unjudged} could not be judged"
        return Judgement(steps.NAME, "not applicable", "; ".join([found, *lost[:1]]))
    return Judgement(steps.NAME, "as specified", f"{judged} handler runs, each following Algorithms 1 to 20")
