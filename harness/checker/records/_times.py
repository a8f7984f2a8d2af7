"""Compare the times of exports, events and handler runs with the time at which the run ended.

An agent exports its chain at its own end: when it is switched off, or when the run ends. An event has the timestamp of
its logging. Virtual time has one clock, so these times are equal. Processes export one after another and on a machine
that may be busy, so their exports and last handler runs may be up to `END_WALL_S` later than the end of the run.

The module also compares the headers of all traces with each other, and checks that the Algorithm number of each trace
line belongs to the handler's name. With the key `stagger`, a scenario gives each agent a different addition to its
timers. The comparison therefore subtracts this addition. The clock of another computer shows another time at mission
second 0, which run.json contains.
"""

from collections.abc import Iterator
from typing import Any

from harness.archive.exports import Export
from harness.archive.traces import Trace
from harness.checker._trace_replay import TraceObservation
from harness.checker.evidence import Evidence
from harness.checker.recorded_inputs import event_of
from harness.checker.records._export_vs_trace import finding
from harness.checker.records.contradiction import Contradiction, in_virtual_time, mission_s, of_agent, slack_s
from harness.checker.reference.algorithms import HANDLERS
from harness.scenario.faults.fault import SAME_TIME_S
from ucp.events import MalformedEventsError
from ucp.trace import HandlerRun
from ucp.trigger import EventTrigger

END_WALL_S = 60.0
"""Maximum number of seconds of wall time that the harness takes to end all agents."""
ROUNDED_END_S = 0.1
"""Rounding error in seconds of the end time in run.json, which has tenths of a second except in virtual time."""


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each export, handler run and event whose time contradicts the end time of the run or the agent's clock."""
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
    """Return the earliest possible time of the export, and the latest possible time of the export and of
    handler runs.
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
    """Return true if the events of the scenario keep the timestamps of a recorded run."""
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
    """Return the mission second of the event's timestamp. Return None if this time is unknown. An event has the
    timestamp 0 if the clock shows a time before its epoch.
    """
    try:
        timestamp_us = event_of(run.input).timestamp_us
    except MalformedEventsError:
        return None
    at_s = mission_s(timestamp_us, trace.header)
    return at_s if timestamp_us or at_s is None else min(at_s, run.t)


WORDS = {"epoch_us": "mission second 0", "initial_data": "the inception block's data"}
MAX_VALUE = 40


def compare_headers(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each trace header whose roster, settings, clock or inception block differs from the other headers."""
    first: dict[str, tuple[object, str]] = {}
    if evidence.record is not None:
        first["roster"] = sorted(evidence.record.roster), "run.json"
    for agent_id, export in evidence.exports.items():
        first.setdefault("initial_data", (export.inception.block_data, f"the export of agent {agent_id}"))
    for agent_id, trace in evidence.traces.items():
        header = trace.header
        expected: dict[str, object] = {"roster": sorted(header.roster)}
        expected |= {f"settings.{name}": value for name, value in _in_common(evidence, agent_id).items()}
        expected["speedup"] = header.clock.get("speedup")
        remote = evidence.remote(agent_id)
        if remote is None or remote.epoch_us is None:
            expected["epoch_us"] = header.clock.get("epoch_us")
        elif remote.epoch_us != header.clock.get("epoch_us"):
            detail = f"its trace has {_short(header.clock.get('epoch_us'))} as {WORDS['epoch_us']}, but run.json has "
            yield of_agent(agent_id, f"{detail}{remote.epoch_us} for the clock of its computer")
        if header.initial_data is not None:
            expected["initial_data"] = header.initial_data
        for name, value in expected.items():
            common, source = first.setdefault(name, (value, f"the trace of agent {agent_id}"))
            if value != common:
                what = WORDS.get(name, name)
                detail = f"its trace has {_short(value)} as {what}, but {source} has {_short(common)}"
                yield of_agent(agent_id, detail)


def _in_common(evidence: Evidence, agent_id: int) -> dict[str, object]:
    """Return the settings of the agent that must be equal for all agents. The agent's own addition to each timer
    duration is subtracted.
    """
    settings: dict[str, Any] = {**evidence.traces[agent_id].header.settings}
    record = evidence.record
    if record is None or not record.stagger or agent_id not in record.roster:
        return settings
    place = sorted(record.roster).index(agent_id)
    for name, step_s in record.stagger.items():
        if isinstance(settings.get(name), int | float):
            settings[name] = round(settings[name] - step_s * place, 6)
    return settings


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= MAX_VALUE else f"{text[:MAX_VALUE]}..."


ALGORITHM = {name: handler.algorithm for name, handler in HANDLERS.items()}


def compare_algorithms(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each trace line whose Algorithm number does not belong to its handler. No other check reads this number."""
    for agent_id, trace in evidence.traces.items():
        said = dict.fromkeys((run.handler, run.algorithm) for run in trace.runs)
        for handler, number in said:
            if handler in ALGORITHM and number != ALGORITHM[handler]:
                detail = f"its trace has {handler} as Algorithm {number}, but it is Algorithm {ALGORITHM[handler]}"
                yield of_agent(agent_id, detail)
