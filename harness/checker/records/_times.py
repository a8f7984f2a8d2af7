"""Compare the times of exports, events and handler runs with the time at which the run ended.

An agent exports its chain when it ends: when it is switched off, or when the run ends. The timestamp of an event is the
time at which the agent logged the event. In virtual time there is only one clock, so the compared times are equal. Real
processes export one after another, and the machine may be busy. Their exports and last handler runs may therefore be up
to `END_WALL_S` later than the end of the run.
"""

from collections.abc import Iterator

from harness.archive.exports import Export
from harness.archive.traces import Trace
from harness.checker._trace_replay import TraceObservation
from harness.checker.evidence import Evidence
from harness.checker.recorded_inputs import event_of
from harness.checker.records._export_vs_trace import finding
from harness.checker.records.contradiction import Contradiction, in_virtual_time, mission_s, of_agent, slack_s
from harness.scenario.faults.fault import SAME_TIME_S
from ucp.events import MalformedEventsError
from ucp.trace import HandlerRun
from ucp.trigger import EventTrigger

END_WALL_S = 60.0
"""Maximum number of seconds of wall time that the harness takes to end all agents."""
ROUNDED_END_S = 0.1
"""Rounding error in seconds of the end time in run.json. A simulated run records the exact time, every other run
records tenths of a second.
"""


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each impossible time:

    - an export or a handler run that is too late after the end of the run
    - an export before the end of the agent
    - an event whose timestamp differs from the time at which the agent logged it
    """
    as_logged = not _has_recorded_events(evidence)
    for agent_id, trace in evidence.traces.items():
        end_s = evidence.end_of(agent_id)
        if end_s is not None:
            earliest_s, latest_s = _around_the_end(evidence, trace, end_s)
            yield from _compare_runs(evidence, agent_id, latest_s)
            export = evidence.exports.get(agent_id)
            if export is not None:
                yield from _compare_export(evidence, agent_id, trace, export, earliest_s, latest_s)
        if as_logged and trace.header.has_inputs:
            yield from _compare_events(evidence, agent_id, trace)


def _around_the_end(evidence: Evidence, trace: Trace, end_s: float) -> tuple[float, float]:
    """Return the earliest and the latest possible time of the export in mission seconds. The latest time also applies
    to handler runs.
    """
    speedup = trace.header.clock.get("speedup")
    if in_virtual_time(trace) or not isinstance(speedup, int | float):
        return end_s - SAME_TIME_S, end_s + SAME_TIME_S
    return end_s - ROUNDED_END_S - slack_s(evidence, trace), end_s + END_WALL_S * speedup


def _compare_runs(evidence: Evidence, agent_id: int, latest_s: float) -> Iterator[Contradiction]:
    for incarnation in evidence.incarnations[agent_id]:
        if incarnation.runs and incarnation.runs[-1].t > latest_s:
            line, run = next((line, run) for line, run in incarnation.numbered_runs() if run.t > latest_s)
            what = f"ran at {run.t:g} s, although the agent ended at {evidence.end_of(agent_id):g} s"
            yield Contradiction(finding(evidence, agent_id, TraceObservation(line, run, what)))


def _compare_export(
    evidence: Evidence, agent_id: int, trace: Trace, export: Export, earliest_s: float, latest_s: float
) -> Iterator[Contradiction]:
    recorded = evidence.recorded(agent_id)
    at_s = mission_s(export.exported_at_us, trace.header)
    if recorded is None or recorded.outcome != "exported" or at_s is None or not export.exported_at_us:
        return
    if not earliest_s <= at_s <= latest_s:
        detail = f"its export is of {at_s:g} s, but the run ended for it at {evidence.end_of(agent_id):g} s"
        yield of_agent(agent_id, detail)


def _has_recorded_events(evidence: Evidence) -> bool:
    """Return true if the events may have timestamps from a recording. The timestamps then differ from the times at
    which the agents logged the events.
    """
    return evidence.scenario is None or any(event.timestamp_us is not None for event in evidence.scenario.events.script)


def _compare_events(evidence: Evidence, agent_id: int, trace: Trace) -> Iterator[Contradiction]:
    slack = max(slack_s(evidence, trace), SAME_TIME_S)
    for incarnation in evidence.incarnations[agent_id]:
        for line, run in incarnation.numbered_runs():
            if not isinstance(run.trigger, EventTrigger):
                continue
            logged_s = _time_of_event(run, trace)
            if logged_s is not None and abs(logged_s - run.t) > slack:
                what = f"logged an event at {run.t:g} s, but the timestamp of the event is {logged_s:g} s"
                yield Contradiction(finding(evidence, agent_id, TraceObservation(line, run, what)))


def _time_of_event(run: HandlerRun, trace: Trace) -> float | None:
    """Return the mission second of the event's timestamp. Return None if it is unknown. The timestamp is 0 if the
    agent's clock showed a negative time. The function then returns at most the time of the handler run.
    """
    try:
        timestamp_us = event_of(run.input).timestamp_us
    except MalformedEventsError:
        return None
    at_s = mission_s(timestamp_us, trace.header)
    return at_s if timestamp_us or at_s is None else min(at_s, run.t)
