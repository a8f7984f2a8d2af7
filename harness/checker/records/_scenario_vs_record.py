"""Compare the scenario with the changes, agents and duration that run.json records.

The scenario fixes all network changes, faults and injections before the run. If run.json lacks one of these entries or
has an additional one, run.json belongs to a different run. Three kinds of changes are in run.json but not in the
scenario: changes because vehicles move, the end of the section `fates`, and the lossless network during the final
reconcile.
"""

from collections.abc import Iterator

from harness.archive.run_record import FaultRecord, JudgedRecord, NetworkState
from harness.checker.evidence import Evidence
from harness.checker.judgement import agents
from harness.checker.records.contradiction import (
    ROUNDED_S,
    Contradiction,
    in_virtual_time,
    of_agent,
    slack_s,
)
from harness.scenario import Scenario
from harness.scenario.changes import FINAL_RECONCILE, NO_MORE_FATES, RANGE, Change, timeline_of
from harness.scenario.faults import Fault
from harness.scenario.faults.fault import SAME_TIME_S
from ucp.settings import ADDED, CHOICES, NUMBERS, Settings

USUAL = Settings()

NOT_IN_A_SCENARIO = (RANGE, NO_MORE_FATES, FINAL_RECONCILE)

LATE_WALL_S = 60.0
"""Maximum delay of a change in seconds of wall time. The limit applies to runs with real processes, whose records
contain only the actual time of a change.
"""

Made = tuple[str, str]
"""The name and the description of a change of the network or of agents."""


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each difference between the recorded scenario and the recorded run."""
    record, scenario = evidence.record, evidence.scenario
    if record is None or scenario is None or record.mission_s is None or record.outcome == "not supported":
        return
    first = min(record.roster, default=0)
    if set(scenario.roster) != set(record.roster):
        differing = agents({*scenario.roster} ^ {*record.roster})
        yield of_agent(first, f"the scenario and the roster of run.json differ in {differing}")
        return
    yield from _compare_changes(evidence, scenario, record, record.mission_s)
    yield from _compare_settings(evidence, scenario)
    if record.outcome == "completed":
        yield from _compare_ends(scenario, record, record.mission_s)


def _compare_changes(
    evidence: Evidence, scenario: Scenario, record: JudgedRecord, mission_s: float
) -> Iterator[Contradiction]:
    """Yield each change of the scenario that is not recorded at its planned time, and each recorded change that the
    scenario does not contain.
    """
    first = min(record.roster, default=0)
    latest = max((slack_s(evidence, trace) for trace in evidence.traces.values()), default=ROUNDED_S)
    late_s = 0.0 if any(map(in_virtual_time, evidence.traces.values())) else LATE_WALL_S * scenario.speedup
    planned = timeline_of(scenario)
    recorded: dict[Made, list[NetworkState | FaultRecord]] = {}
    for entry in _recorded(record):
        recorded.setdefault((entry.what, entry.detail), []).append(entry)
    for change in planned:
        entries = recorded.get((change.what, change.detail), [])
        made = next((entry for entry in entries if _is_at(entry, change, late_s)), None)
        if made is not None:
            entries.remove(made)
        elif change.at_s < mission_s - latest or (record.outcome == "completed" and record.cycle is None):
            what = f"the scenario has {_in_words(change)}"
            times = " and ".join(f"{entry.at_s:g} s" for entry in entries)
            detail = f"{what}, but run.json has this change at {times}" if times else f"{what}, but run.json lacks it"
            entries.clear()
            yield of_agent(min(_agents_of(change), default=first), detail)
    for unplanned in (entry for entries in recorded.values() for entry in entries):
        at_s = f"{unplanned.what} at {unplanned.at_s:g} s, {unplanned.detail}"
        named = unplanned.agents or () if isinstance(unplanned, FaultRecord) else ()
        yield of_agent(min(named, default=first), f"run.json has {at_s}, but its scenario does not")


def _recorded(record: JudgedRecord) -> Iterator[NetworkState | FaultRecord]:
    """Yield each recorded change once. The list `faults` repeats all network changes except the initial one."""
    yield from (state for state in record.network if state.what not in NOT_IN_A_SCENARIO)
    yield from (fault for fault in record.faults if fault.fully_connected is None)


def _is_at(entry: NetworkState | FaultRecord, change: Change, late_s: float) -> bool:
    if entry.planned_s is not None:
        return abs(entry.planned_s - change.at_s) < SAME_TIME_S
    return -SAME_TIME_S < entry.at_s - change.at_s < SAME_TIME_S + late_s


def _agents_of(change: Change) -> tuple[int, ...]:
    return change.agents if isinstance(change, Fault) else ()


def _in_words(change: Change) -> str:
    return f"{change.what} at {change.at_s:g} s, {change.detail}"


def _compare_settings(evidence: Evidence, scenario: Scenario) -> Iterator[Contradiction]:
    """Yield each trace header with missing settings, or with values that differ from the scenario."""
    for agent_id, trace in evidence.traces.items():
        if agent_id not in scenario.roster:
            continue
        asked = scenario.settings_of(agent_id)
        for name in NUMBERS | CHOICES:
            value = getattr(asked, name)
            if name not in trace.header.settings and name not in ADDED:
                yield of_agent(agent_id, f"the header of its trace lacks the setting {name}")
                continue
            recorded = trace.header.settings.get(name, getattr(USUAL, name))
            if recorded != value:
                yield of_agent(
                    agent_id, f"its trace has {name} {recorded}, but by the scenario in run.json it is {value}"
                )


def _compare_ends(scenario: Scenario, record: JudgedRecord, mission_s: float) -> Iterator[Contradiction]:
    first = min(record.roster, default=0)
    if record.cycle is None and mission_s < scenario.duration_s - SAME_TIME_S:
        detail = f"run.json has a completed run of {mission_s:g} s, but its scenario lasts {scenario.duration_s:g} s"
        yield of_agent(first, detail)
    if record.final_reconcile is not None and not scenario.final_reconcile:
        yield of_agent(first, "run.json has a final reconcile, but its scenario asks for none")
    if record.final_reconcile is None and scenario.final_reconcile and record.cycle is None:
        yield of_agent(first, "the scenario in run.json asks for a final reconcile, but run.json has none")
