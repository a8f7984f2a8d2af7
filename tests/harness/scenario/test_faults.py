"""Test the faults of agents: kill, crash, restart, pause, resume, reboot, switching off, and wrong clocks."""

from itertools import pairwise
from random import Random
from typing import Any

import pytest
from pydantic import ValidationError

from harness.archive.run_record import FaultRecord, JudgedRecord
from harness.archive.traces import Trace, TraceHeader
from harness.checker import Evidence
from harness.checker._agreement import find_agents_with_chance
from harness.play.backend import agent_seed
from harness.run.simulate import Simulated, simulate
from harness.scenario import Scenario
from tests.harness.virtual import scenario
from ucp.events import RandomEvents
from ucp.store import StoredState
from ucp.trace import HandlerRun, StateSummary
from ucp.trigger import BootTrigger, UnknownTrigger


def faulty(timeline: list[dict[str, Any]], **keys: Any) -> Scenario:
    return scenario(timeline=timeline, **{"duration_s": 600, "events": {"source": "random", "mean_s": 10}, **keys})


def played(timeline: list[dict[str, Any]], **keys: Any) -> Simulated:
    return simulate(faulty(timeline, **keys), 4, tracing=True)


REBOOT = {"at_s": 10, "reboot": [1], "down_s": 20, "disk": "kept"}


def verdicts(simulated: Simulated) -> set[str]:
    return {one.verdict for one in simulated.result.characteristics.values()}


def test_killed_agent_leaves_no_export() -> None:
    simulated = played([{"at_s": 300, "kill": [2, 5]}], final_reconcile=True)
    assert sorted(simulated.evidence.exports) == [1, 3, 4]
    assert simulated.played.agents["2"].outcome == "killed"
    assert max(run.t for run in simulated.evidence.traces[2].runs) <= 300
    assert verdicts(simulated) == {"holds"}
    blocks, left = simulated.result.figures["blocks"], len(simulated.evidence.exports[1].chain)
    gone = f"; {blocks - left} more were lost with agents that were killed" if blocks != left else ""  # type: ignore[operator]
    assert simulated.result.characteristics["5"].reason == f"all {left} completed blocks are in every chain{gone}"


def test_blocks_lost_with_a_killed_agent_are_no_violation() -> None:
    alone = [{"at_s": 0, "partition": [[1], [2, 3]]}, {"at_s": 400, "kill": [1]}, {"at_s": 401, "heal": True}]
    simulated = played(alone, agents=3, final_reconcile=True)
    everywhere = simulated.result.characteristics["5"]
    assert everywhere.verdict == "holds"
    assert "more were lost with agents that were killed" in everywhere.reason
    assert simulated.result.figures["copies_min"] == 0


def test_restarted_agent_starts_empty_and_recovers_the_chain() -> None:
    simulated = played([{"at_s": 300, "kill": [2]}, {"at_s": 330, "restart": [2]}], final_reconcile=True)
    trace = simulated.evidence.traces[2]
    first, second = ([run for _, run in life] for life in trace.incarnations())
    assert max(run.t for run in first) <= 300 < 330 <= min(run.t for run in second)
    assert second[0].state.chain == 0
    completed = simulated.evidence.exports[2].completed
    assert {run.changes[0][1] for run in first if run.branch == "full"}.isdisjoint(completed)
    assert len(simulated.evidence.exports[2].chain) >= 30
    assert verdicts(simulated) == {"holds"}


def test_restarted_agent_receives_no_message_sent_before_its_start() -> None:
    slow = {"delay": 10.0}
    simulated = played([{"at_s": 300, "kill": [2]}, {"at_s": 301, "restart": [2]}], network=slow)
    heard = [run.t for run in simulated.evidence.traces[2].runs if run.trigger.kind == "message"]
    assert not [t for t in heard if 300 < t < 311]
    assert [t for t in heard if t < 300 or t > 311]
    assert agent_seed(4, 2) != agent_seed(4, 2, incarnation=2)


def test_restarted_agent_logs_no_event_of_its_first_incarnation() -> None:
    """The events that the agent had not logged when it was killed are lost."""
    simulated = played([{"at_s": 300, "kill": [2]}, {"at_s": 300.5, "restart": [2]}])
    source = RandomEvents(Random(agent_seed(4, 2, incarnation=2)), mean_s=10)
    expected = [t for t in (300.5 + source.next()[0] for _ in range(100)) if t <= 600]
    assert [
        run.t for run in simulated.evidence.traces[2].runs if run.t > 300 and run.trigger.kind == "event"
    ] == expected


@pytest.mark.parametrize("seed", range(5))
def test_reboot_with_kept_disk_loses_no_block(seed: int) -> None:
    reboots = [
        {"at_s": 203.0, "reboot": [2, 3], "down_s": 20, "disk": "kept"},
        {"at_s": 411.0, "reboot": [2], "down_s": 1, "disk": "kept"},
    ]
    simulated = simulate(faulty(reboots, network={"loss": 0.3}, final_reconcile=True), seed, tracing=True)
    assert verdicts(simulated) == {"holds"}
    assert simulated.result.characteristics["5"].reason.endswith("blocks are in every chain")
    agent = simulated.played.agents["2"]
    assert (agent.outcome, agent.restarts, agent.reboots, agent.completed_before) == ("exported", 0, 2, [])
    trace = simulated.evidence.traces[2]
    first, second, third = ([run for _, run in life] for life in trace.incarnations())
    assert max(run.t for run in first) <= 203 < 223 <= min(run.t for run in second)
    assert (second[0].t, second[0].trigger) == (223, BootTrigger(first[-1].state.chain))
    assert (third[0].t, third[0].handler) == (412, "reconcile_finalize")
    completed = simulated.evidence.exports[2].completed
    assert completed == list(dict.fromkeys(trace.completed()))
    assert [fault.what for fault in simulated.played.faults[:4]] == ["reboot", "boot", "reboot", "boot"]


def test_reboot_with_lost_disk_equals_kill_and_restart() -> None:
    rebooted = played([{"at_s": 300, "reboot": [2], "down_s": 30, "disk": "lost"}], final_reconcile=True)
    killed = played([{"at_s": 300, "kill": [2]}, {"at_s": 330, "restart": [2]}], final_reconcile=True)
    assert rebooted.played.agents == killed.played.agents
    assert rebooted.evidence.exports == killed.evidence.exports
    assert rebooted.evidence.traces == killed.evidence.traces
    assert verdicts(rebooted) == {"holds"}


def test_crash_equals_kill_in_virtual_time() -> None:
    crashed, killed = played([{"at_s": 300, "crash": [2]}]), played([{"at_s": 300, "kill": [2]}])
    assert crashed.evidence.exports == killed.evidence.exports
    assert crashed.played.agents == killed.played.agents


def test_stale_chain_hash_violates_characteristic_4() -> None:
    simulated = played([], network={"loss": 0.3}, quirks={"stale_chain_hash": True})
    genuine = simulated.result.characteristics["4"]
    assert genuine.verdict == "violated"
    exported = [finding.detail for finding in genuine.evidence if "trace line" not in finding.detail]
    traced = [finding.detail for finding in genuine.evidence if "trace line" in finding.detail]
    assert {detail.partition(" at block ")[0] for detail in exported} == {"the chain hash"}
    assert all("receive_response_block_for_hash: the top chain hash" in detail for detail in traced)


def test_block_lost_in_a_brown_out_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    """An agent that keeps its disk must not lose blocks."""
    alone = [{"at_s": 0, "partition": [[2], [1, 3, 4, 5]]}, {"at_s": 400, "heal": True}]
    reboot = {"at_s": 300, "reboot": [2], "down_s": 30, "disk": "kept"}
    assert verdicts(played([*alone, reboot], final_reconcile=True)) == {"holds"}
    monkeypatch.setattr("harness.play.simulation._simulated_agent.StoredState.of", lambda agent: StoredState())
    assert played([*alone, reboot], final_reconcile=True).result.characteristics["5"].verdict == "violated"


def test_reconcile_ended_by_a_brown_out_counts_as_no_chance_to_agree() -> None:
    """When the agent restarts, its reconcile has ended without answers of other agents."""
    began = {"handler": "reconcile_begin", "algorithm": 7, "branch": "begun", "reconciling": True}
    ended = {"handler": "reconcile_finalize", "algorithm": 20, "branch": "done", "reconciling": False}
    runs = [run_of(10.0, **began), run_of(20.0, **ended)]
    connected = [{"at_s": 0.0, "what": "start", "detail": "", "fully_connected": True}]
    record = JudgedRecord.model_validate({"roster": [1], "network": connected})
    header = TraceHeader(agent_id=1, roster=[1], settings={}, clock={})
    without_boot, with_boot = Trace(header, runs), Trace(header, runs, starts=[1])
    assert find_agents_with_chance(Evidence({}, {1: without_boot}, record), {1}) == {1}
    assert find_agents_with_chance(Evidence({}, {1: with_boot}, record), {1}) == set()


def run_of(t: float, *, handler: str, algorithm: int, branch: str, reconciling: bool) -> HandlerRun:
    return HandlerRun(
        t,
        handler,
        algorithm,
        UnknownTrigger({}),
        branch,
        [],
        [],
        StateSummary(0, 0, 0, reconciling, not reconciling, ""),
    )


def test_blocks_of_a_restarted_agent_are_known_without_traces() -> None:
    one = scenario(
        duration_s=600,
        events={"source": "random", "mean_s": 10},
        timeline=[{"at_s": 300, "kill": [2]}, {"at_s": 330, "restart": [2]}],
    )
    assert simulate(one, 4).result.characteristics["4"].verdict == "holds"


def test_resumed_agent_handles_the_messages_that_waited() -> None:
    simulated = played([{"at_s": 200, "pause": [3]}, {"at_s": 320, "resume": [3]}], final_reconcile=True)
    times = [run.t for run in simulated.evidence.traces[3].runs]
    assert not [t for t in times if 200 < t < 320]
    assert times.count(320) > 5
    assert verdicts(simulated) == {"holds"}


def test_vote_lasts_longer_while_its_agent_is_paused() -> None:
    script = [{"at_s": at_s, "agent": 1} for at_s in (1, 2, 3)]
    pause = [{"at_s": 5, "pause": [1]}, {"at_s": 60, "resume": [1]}]
    simulated = played(pause, events={"source": "scripted", "script": script}, duration_s=100)
    assert [run.t for run in simulated.evidence.traces[1].runs if run.handler == "vote_timer_expiration"] == [60]
    assert verdicts(simulated) == {"holds"}


def test_agent_that_stays_paused_leaves_the_run_unsettled() -> None:
    simulated = played([{"at_s": 500, "pause": [1]}], final_reconcile=True)
    assert not simulated.played.settled
    assert simulated.played.final_reconcile is not None
    assert not simulated.played.final_reconcile.complete
    assert max(run.t for run in simulated.evidence.traces[1].runs) <= 500


@pytest.mark.parametrize(("offset_s", "drift"), [(-1000, 0.0), (1000, 0.0), (0, 0.01), (-50, -0.2)])
def test_agents_agree_with_wrong_and_drifting_clocks(offset_s: float, drift: float) -> None:
    """Timers and timestamps follow the inaccurate clock. A time before the start of the run has the timestamp 0."""
    simulated = played([], clocks={2: {"offset_s": offset_s, "drift": drift}}, final_reconcile=True)
    assert verdicts(simulated) == {"holds"}
    own = [block for block in simulated.evidence.exports[1].chain if block.agent_id == 2]
    others = [block for block in simulated.evidence.exports[1].chain if block.agent_id == 1]
    assert max(block.timestamp_us for block in own) <= max(0, (offset_s + 600 * (1 + drift)) * 1e6) + len(own)
    assert max(block.timestamp_us for block in others) <= 600e6
    votes = [
        run
        for run in simulated.evidence.traces[2].runs
        if run.handler in ("process_next_deque_block", "vote_timer_expiration")
    ]
    spans = [
        end.t - begin.t
        for begin, end in pairwise(votes)
        if begin.branch == "proposed" and end.handler == "vote_timer_expiration"
    ]
    assert spans
    assert all(span == pytest.approx(10 / (1 + drift)) for span in spans)


@pytest.mark.parametrize(
    ("timeline", "sentence"),
    [
        ([{"at_s": 1, "restart": [1]}], "timeline.0.restart: agent 1 is running at that time, not killed"),
        ([{"at_s": 1, "kill": [1]}, {"at_s": 2, "pause": [1]}], "timeline.1.pause: agent 1 is killed at that time"),
        ([{"at_s": 2, "resume": [1]}], "timeline.0.resume: agent 1 is running at that time, not paused"),
        ([{"at_s": 2, "kill": [1, 1]}], "agent 1 is killed at that time"),
        ([{"at_s": 2, "kill": [9]}], "timeline.0.kill names vehicle 9, which is not on the roster"),
        ([{"at_s": 2, "kill": []}], "at least 1 item"),
        ([{"at_s": 2, "kill": [1], "heal": True}], "needs exactly one of"),
        ([{"at_s": 2, "crash": [9]}], "timeline.0.crash names vehicle 9, which is not on the roster"),
        (
            [{"at_s": 1, "kill": [1]}, REBOOT],
            "timeline.1.reboot: agent 1 is killed at that time, not running or paused",
        ),
        (
            [REBOOT, {"at_s": 25, "kill": [1]}],
            "timeline.1.kill: agent 1 is rebooting at that time, not running or paused",
        ),
        ([{**REBOOT, "down_s": 1191}], "its agents would be back at 1201 s, after the mission's end at 1200 s"),
        ([{"at_s": 10, "reboot": [1], "disk": "kept"}], "a reboot needs `down_s`"),
        ([{"at_s": 10, "reboot": [1], "down_s": 20}], "a reboot needs .* `disk: kept` or `disk: lost`"),
        ([{"at_s": 10, "kill": [1], "disk": "lost"}], "`down_s` and `disk` belong to `reboot`"),
        ([{"at_s": 10, "kill": [1, 2, 3]}, {"at_s": 20, "crash": [4, 5]}], "the timeline kills all agents"),
    ],
)
def test_impossible_faults_are_refused(timeline: list[dict[str, Any]], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        scenario(timeline=timeline)


def test_fault_at_the_instant_of_a_boot_follows_the_boot() -> None:
    scenario(timeline=[{"at_s": 30, "kill": [1]}, REBOOT])


def test_crash_without_vehicles_is_refused() -> None:
    crash = [{"at_s": 10, "crash": [1]}]
    with pytest.raises(ValidationError, match=r"timeline\.0\.crash needs vehicles that can fall"):
        scenario(timeline=crash, vehicles={"kind": "none"})
    scenario(timeline=crash)


def test_unknown_fault_in_a_record_has_no_effect() -> None:
    unknown = FaultRecord(at_s=1.0, what="earthquake", detail="agent 1", agents=[1])
    assert not unknown.loses_data
    assert not (unknown.kind.ends_incarnation or unknown.kind.removes_vehicle or unknown.kind.mark)


@pytest.mark.parametrize(("disk", "loses"), [("kept", False), ("lost", True)])
def test_reboot_loses_data_only_with_its_disk(disk: Any, loses: bool) -> None:
    assert FaultRecord(at_s=1.0, what="reboot", detail="agent 1", agents=[1], disk=disk).loses_data == loses


def test_landed_agent_logs_no_events_and_still_votes() -> None:
    simulated = played([{"at_s": 300, "stop_events": [2, 5]}], network={"loss": 0.2})
    assert not [run.t for run in simulated.evidence.traces[2].runs if run.trigger.kind == "event" and run.t > 300]
    assert [run.t for run in simulated.evidence.traces[1].runs if run.trigger.kind == "event" and run.t > 300]
    assert [run for run in simulated.evidence.traces[2].runs if run.branch == "committed" and run.t > 320]


def test_switched_off_agent_exports_its_chain_and_loses_nothing() -> None:
    simulated = played([{"at_s": 300, "switch_off": [2, 5]}], final_reconcile=True)
    assert sorted(simulated.evidence.exports) == [1, 2, 3, 4, 5]
    assert simulated.evidence.exports[2].exported_at_us == 300_000_000
    assert simulated.played.agents["2"].outcome == "exported"
    assert simulated.played.agents["2"].detail == "switched off at 300 s"
    assert max(run.t for run in simulated.evidence.traces[2].runs) <= 300
    assert not simulated.result.bad
    uniform = simulated.result.characteristics["6"]
    assert uniform.verdict == "holds" and "without agents 2 and 5, which were switched off" in uniform.reason
    assert simulated.result.beside["liveness"].verdict == "finished"


def test_block_held_only_by_a_switched_off_agent_is_no_violation() -> None:
    alone = [{"at_s": 0, "partition": [[1], [2, 3]]}, {"at_s": 400, "switch_off": [1]}, {"at_s": 401, "heal": True}]
    simulated = played(alone, agents=3, final_reconcile=True)
    assert not simulated.result.bad
    assert "8 more were lost with agents that were killed or switched off" in (
        simulated.result.characteristics["5"].reason
    )


def test_liveness_does_not_apply_to_switched_off_agents() -> None:
    """Switch off one agent after another while they vote."""
    off = [{"at_s": 580 + agent, "switch_off": [agent]} for agent in range(1, 6)]
    simulated = played(off, network={"loss": 0.3})
    assert not simulated.result.bad
    assert simulated.result.beside["liveness"].verdict == "not applicable"
    assert "switched off before" in simulated.result.beside["liveness"].reason
    assert simulated.result.characteristics["6"].verdict == "not applicable"


def test_switched_off_agent_cannot_restart() -> None:
    with pytest.raises(ValidationError, match="agent 2 is switched off at that time, not killed"):
        faulty([{"at_s": 300, "switch_off": [2]}, {"at_s": 400, "restart": [2]}])
