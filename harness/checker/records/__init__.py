"""Compare different records of the same facts. A contradiction between two records is a finding.

Each file in this folder contains a function that compares records in an `Evidence` and yields each `Contradiction`. An
unaltered run has no contradiction, because its records also list each kill, restart, reboot, pause, rogue node and full
disk.

If records contradict each other or are incomplete, the verdict on a characteristic may rest on wrong facts. The
function `in_doubt` then replaces the verdict.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from harness.checker.evidence import Evidence
from harness.checker.judgement import MAX_EVIDENCE, Finding, Judgement, agents, times
from harness.checker.records import (
    _captures_vs_traces,
    _channel_vs_traces,
    _conditions_vs_network,
    _counters,
    _datagrams_vs_traces,
    _export_vs_store,
    _export_vs_trace,
    _handled_vs_faults,
    _headers,
    _heard_vs_sent,
    _losses,
    _scenario_vs_record,
    _times,
)
from harness.checker.records.contradiction import Contradiction

NAME = "every record"

COMPARISONS: tuple[Callable[[Evidence], Iterator[Contradiction]], ...] = (
    _headers.compare_headers,
    _headers.compare_algorithms,
    _export_vs_trace.compare_with_itself,
    _counters.compare_counters_of_run,
    _export_vs_trace.compare_export,
    _counters.compare_completed_blocks,
    _heard_vs_sent.compare,
    _handled_vs_faults.compare,
    _conditions_vs_network.compare,
    _scenario_vs_record.compare,
    _times.compare,
    _export_vs_store.compare,
    _losses.compare,
    _channel_vs_traces.compare,
    _captures_vs_traces.compare_counters,
    _captures_vs_traces.compare_captures,
    _datagrams_vs_traces.find_unrecorded,
    _datagrams_vs_traces.find_unread,
)

NEEDS_ALL_LINES = (_heard_vs_sent.compare,)
"""Comparisons that are omitted for records from the field, because they need complete traces. In the field, the trace
of an agent's first incarnation may be missing. A restarted agent numbers its messages from 0 again, so the comparison
would take messages of different incarnations for the same message.
"""


@dataclass(frozen=True)
class RecordComparisons:
    """The result of all comparisons between the records of a run."""

    contradictions: list[Contradiction]
    short: dict[int, str]
    """Agent with an incomplete trace -> the reason why the trace is incomplete."""
    unsent: dict[int, int]
    """Agent -> number of messages that the agent could not send, according to the agent's own count."""

    def touching(self, number: str) -> list[Finding]:
        """Return the contradictions between records that decide the verdict on the characteristic with this number."""
        return [contradiction.finding for contradiction in self.contradictions if contradiction.touches == number]


def cross_examine(evidence: Evidence) -> RecordComparisons:
    """Run all comparisons between the records of a run, and return their results."""
    comparisons = [compare for compare in COMPARISONS if not evidence.from_field or compare not in NEEDS_ALL_LINES]
    contradictions = [contradiction for compare in comparisons for contradiction in compare(evidence)]
    if evidence.from_field:
        lacking = [contradiction for contradiction in contradictions if contradiction.short]
        contradictions = [contradiction for contradiction in contradictions if not contradiction.short]
    else:
        lacking = contradictions
    short = {agent_id: trace.problem for agent_id, trace in evidence.traces.items() if trace.problem}
    for contradiction in lacking:
        if contradiction.short:
            short.setdefault(contradiction.finding.agent_id, contradiction.finding.detail)
    for agent_id in _agents_without_known_end(evidence):
        short.setdefault(agent_id, "the run did not end normally, so the expected end of the trace is unknown")
    unsent = {agent_id: failures for agent_id in evidence.traces if (failures := evidence.send_failures(agent_id))}
    return RecordComparisons(contradictions, short, unsent)


def _agents_without_known_end(evidence: Evidence) -> Iterator[int]:
    """Yield each agent of an interrupted run for which run.json does not contain the number of handler runs. The end of
    the agent's trace may then be missing.
    """
    if evidence.record is None or evidence.record.outcome != "running":
        return
    for agent_id in evidence.traces:
        recorded = evidence.recorded(agent_id)
        if recorded is None or not recorded.handler_runs:
            yield agent_id


def check(evidence: Evidence) -> Judgement:
    """Return the verdict on the records. It is `contradict` after any contradiction, `not applicable` if a trace is
    missing or incomplete, and `agree` otherwise.
    """
    examination = evidence.cached(cross_examine)
    findings = [contradiction.finding for contradiction in examination.contradictions]
    if findings:
        reason = f"{times(len(findings))}: two records contradict each other"
        return Judgement(NAME, "contradict", reason, findings[:MAX_EVIDENCE])
    if not evidence.traces:
        return Judgement(NAME, "not applicable", "the run has no traces to compare with the exports")
    if untraced := sorted(set(evidence.roster or evidence.exports) - set(evidence.traces)):
        return Judgement(
            NAME,
            "not applicable",
            f"the trace of {agents(untraced)} is missing, so it is not compared with the other records",
        )
    if examination.short:
        return Judgement(NAME, "not applicable", describe_incomplete(examination))
    if not evidence.exports:
        return Judgement(NAME, "not applicable", "the run has no chain exports to compare with the traces")
    if unknown := evidence.describe_unknown_name("trigger", "handler", "branch", "message", "operation"):
        return Judgement(NAME, "not applicable", unknown)
    runs = sum(len(trace.runs) for trace in evidence.traces.values())
    record = " and run.json" if evidence.record else ""
    return Judgement(
        NAME, "agree", f"{runs} handler runs in {len(evidence.traces)} traces, {len(evidence.exports)} exports{record}"
    )


def describe_incomplete(examination: RecordComparisons) -> str:
    """Return a phrase about the incomplete traces, such as "the trace of agent 3 is incomplete: ...". At least one
    trace must be incomplete.
    """
    agent_id, why = next(iter(examination.short.items()))
    others = len(examination.short) - 1
    more = f"; so are the traces of {others} more" if others else ""
    return f"the trace of agent {agent_id} is incomplete: {why}{more}"


NEEDS_TRACES = frozenset("123")
"""Characteristics that must hold after every step. Without complete traces, the verdict `holds` becomes `not
applicable`.
"""
NEEDS_CONNECTIVITY = frozenset("56")
"""Characteristics that require full connectivity. If an agent could not send messages, it was not connected, so the
verdict `violated` becomes `not applicable`.
"""


def in_doubt(number: str, judgement: Judgement, examination: RecordComparisons) -> Judgement:
    """Return the judgement on the characteristic with this number. The verdict becomes `violated` if the records behind
    it contradict each other, and `not applicable` if it needs records that are incomplete.
    """
    touching = examination.touching(number)
    if touching:
        contradict = f"{times(len(touching))}: the records behind this verdict contradict each other"
        violated = judgement.verdict == "violated"
        reason = f"{judgement.reason}; {contradict}" if violated else contradict
        evidence = [*(judgement.evidence if violated else ()), *touching]
        return Judgement(judgement.name, "violated", reason, evidence[:MAX_EVIDENCE])
    if judgement.verdict == "holds" and number in NEEDS_TRACES and examination.short:
        return Judgement(judgement.name, "not applicable", describe_incomplete(examination))
    if judgement.verdict == "violated" and number in NEEDS_CONNECTIVITY and examination.unsent:
        unsent = sum(examination.unsent.values())
        reason = f"{agents([*examination.unsent])} could not send {unsent} messages, so not all agents were connected"
        return Judgement(judgement.name, "not applicable", reason)
    return judgement
