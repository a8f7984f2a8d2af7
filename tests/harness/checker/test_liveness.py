"""Test the liveness check: it reports an idle swarm, an endless cycle, or an estimate of the remaining time."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from harness.checker import check
from harness.checker.evidence import Evidence
from harness.checker.judgement import Judgement
from harness.checker.recurring_cycles import cycle_of
from harness.play.simulation.simulation import Simulation
from harness.run.simulate import Simulated, simulate
from harness.scenario import Scenario
from harness.scenario.load import load_scenario
from tests.harness.command import harness, write_scenario
from tests.harness.play.test_recurrence import in_step
from tests.harness.scenario.test_scenarios import LIVELOCKS, SCENARIOS
from tests.harness.virtual import scenario
from ucp.quirks import CRASHED


def liveness(simulated: Simulated) -> Judgement:
    return simulated.result.beside["liveness"]


def judged(evidence: Evidence, **record: Any) -> dict[str, Judgement]:
    """Return the judgements of a run whose record was changed."""
    assert evidence.record is not None
    changed = replace(evidence, record=evidence.record.model_copy(update=record))
    return check(changed).judgements


def disable_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the search for endless cycles, so that a simulation runs to its time limit."""
    monkeypatch.setattr(Simulation, "_new_recurrence", lambda simulation: None)


def test_idle_swarm_has_finished() -> None:
    run = simulate(scenario(agents=5, duration_s=600), seed=1)
    uniform_at_s = run.result.figures["uniform_at_s"]
    assert liveness(run).verdict == "finished"
    assert liveness(run).reason == (
        f"all 5 agents were idle at {run.played.mission_s:.0f} s, with one chain since {uniform_at_s:.1f} s"
    )


@pytest.mark.parametrize("tracing", [False, True])
def test_swarm_in_step_never_finishes_and_violates_5_and_6(tracing: bool) -> None:
    run = simulate(in_step(), seed=1, tracing=tracing)
    assert liveness(run).verdict == "never finishes"
    for phrase in ("the global state recurs every 15 s", "agents 1, 2, 3, 4 and 5 ask each other in vain"):
        assert phrase in liveness(run).reason
    for number in ("5", "6"):
        reason = run.result.characteristics[number].reason
        assert re.fullmatch(
            r"the system is fully connected, but agents 1, 2, 3, 4 and 5 have repeated the same cycle since "
            r"\d+ s",
            reason,
        )
    assert {"5", "6", "liveness"} == set(run.result.bad)
    (finding,) = liveness(run).evidence
    assert finding.agent_id == 1
    assert finding.detail.startswith("as agents 2, 3, 4 and 5, runs ")
    assert "vote_timer_expiration" in finding.detail


def test_traces_show_the_handlers_and_the_start_of_a_cycle() -> None:
    run = simulate(in_step(), seed=1, tracing=True)
    assert "since 11 s" in liveness(run).reason, "the first reconcile in step, long before the search started"
    assert liveness(run).reason.endswith("; agents 1, 2, 3, 4 and 5 refuse each other's blocks")
    assert liveness(run).evidence[0].detail == (
        "as agents 2, 3, 4 and 5, runs vote_timer_expiration (not approved), reconcile_begin (begun), reconcile_phase_1"
        " (asked), 5 s later reconcile_phase_1_timer_expiration (no response), reconcile_finalize (done),"
        " process_next_deque_block (proposed); 10 s later it starts again"
    )


def test_traces_alone_show_a_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    disable_search(monkeypatch)
    run = simulate(in_step(), seed=1, tracing=True)
    assert run.played.cycle is None
    assert liveness(run).verdict == "never finishes"
    repeated = re.search(
        r"since 11 s: the same handler runs follow each other every 15 s, (\d+) times in a row; agents 1, 2, 3, 4 and 5"
        r" ask each other in vain",
        liveness(run).reason,
    )
    assert repeated and int(repeated[1]) == (1860 - 11) // 15
    assert {"5", "6", "liveness"} == set(run.result.bad)


@pytest.mark.parametrize("name", LIVELOCKS)
def test_traces_show_a_cycle_at_any_end_of_the_run(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Find the cycle even if some of its agents are idle at the end of the run."""
    disable_search(monkeypatch)
    document = load_scenario(SCENARIOS / f"{name}.yaml").model_dump(exclude={"expect"}, exclude_unset=True)
    idle, in_cycle = set(), set()
    for more_s in range(0, 30, 2):
        run = simulate(Scenario.model_validate({**document, "settle": {"limit_s": 250 + more_s}}), seed=1, tracing=True)
        assert liveness(run).verdict == "never finishes", f"{run.played.mission_s:.0f} s"
        assert run.evidence.cached(cycle_of) is not None
        assert set(run.evidence.busy) <= set(run.evidence.cached(cycle_of).agents)
        idle.add(len(run.evidence.busy))
        in_cycle.add(tuple(run.evidence.cached(cycle_of).agents))
    assert len(idle) > 1 or name != "drawn_in"
    assert len(in_cycle) == 1, "the cycle contains idle agents too"


def test_few_repetitions_do_not_count_as_a_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    disable_search(monkeypatch)
    run = simulate(in_step(settle={"limit_s": 10}), seed=1, tracing=True)
    assert liveness(run).verdict == "not finished"
    assert "5 blocks waited for their commit, and none was" in liveness(run).reason
    assert "it is unknown whether" in liveness(run).reason
    assert run.result.characteristics["5"].verdict == "not applicable"


def test_repetitions_on_a_lossy_network_do_not_count_as_a_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    disable_search(monkeypatch)
    evidence = simulate(in_step(), seed=1, tracing=True).evidence
    assert evidence.record is not None
    lossy = [state.model_copy(update={"fully_connected": False}) for state in evidence.record.network]
    assert judged(evidence, network=lossy)["liveness"].verdict == "not finished"


def test_commit_rate_gives_an_estimate_of_the_remaining_time() -> None:
    busy: dict[str, Any] = {"agents": 5, "duration_s": 600, "events": {"source": "random", "mean_s": 4}}
    cut = simulate(scenario(**busy, settle={"limit_s": 400}), seed=1, tracing=True)
    assert liveness(cut).verdict == "not finished"
    estimate = re.search(r"at ([\d.]+) commits a minute this would have taken (\d+) minutes more", liveness(cut).reason)
    assert estimate, liveness(cut).reason
    finished = simulate(scenario(**busy, settle={"limit_s": 4000}), seed=1)
    assert liveness(finished).verdict == "finished"
    needed_minutes = (finished.played.mission_s - cut.played.mission_s) / 60
    assert needed_minutes / 2 < int(estimate[2]) < needed_minutes * 2
    assert cut.result.bad == ("liveness",), "characteristics 5 and 6 are not judged before the swarm is idle"


def test_commit_rate_is_unknown_without_traces() -> None:
    busy = scenario(agents=5, duration_s=600, events={"source": "random", "mean_s": 4}, settle={"limit_s": 400})
    assert "without traces the commit rate is unknown" in liveness(simulate(busy, seed=1)).reason


def test_hanging_agent_never_finishes() -> None:
    hanging = scenario(agents=4, duration_s=900, network={"loss": 0.3}, quirks={"crash_on_tie": True})
    verdicts = [liveness(simulate(hanging, seed)) for seed in range(10)]
    hang = [verdict for verdict in verdicts if verdict.verdict == "never finishes"]
    assert hang
    assert all("no running timer can change this" in verdict.reason for verdict in hang)


def test_traces_show_since_when_an_agent_hangs() -> None:
    hanging = scenario(agents=4, duration_s=900, network={"loss": 0.3}, quirks={"crash_on_tie": True})
    for seed in range(10):
        run = simulate(hanging, seed, tracing=True)
        cycle = run.evidence.cached(cycle_of)
        if cycle is not None:
            tied_at = {
                agent_id: next(line.t for line in trace.runs if line.branch.endswith(CRASHED))
                for agent_id, trace in run.evidence.traces.items()
                if agent_id in cycle.agents
            }
            assert max(tied_at.values()) <= cycle.since_s <= run.played.mission_s


def test_liveness_is_not_applicable_without_complete_evidence() -> None:
    evidence = simulate(scenario(agents=3, duration_s=600), seed=1).evidence
    for outcome in ("running", "interrupted", "failed"):
        judgement = judged(evidence, outcome=outcome)["liveness"]
        assert (judgement.verdict, judgement.reason) == (
            "not applicable",
            f"the run did not end normally ({outcome})",
        )
    exports_alone = check(Evidence(evidence.exports)).beside["liveness"]
    assert exports_alone.verdict == "not applicable"
    some = Evidence({1: evidence.exports[1]}, record=evidence.record)
    assert check(some).beside["liveness"].reason == "the export of agents 2 and 3 is missing"


def test_agent_paused_to_the_end_is_not_judged() -> None:
    run = simulate(scenario(agents=3, duration_s=600, timeline=[{"at_s": 100, "pause": [3]}]), seed=1)
    assert (liveness(run).verdict, liveness(run).reason) == ("not applicable", "agent 3 stayed paused to the end")


def test_reconcile_beside_a_paused_agent_is_no_chance_to_agree() -> None:
    """Agent 3 alone has a block. The agent is paused until the end of the run, so it answers no query of the final
    reconcile.
    """
    run = simulate(
        scenario(
            agents=3,
            duration_s=60,
            settings={"max_block_bytes": 267},
            events={"source": "scripted", "script": [{"at_s": 1, "agent": 3}, {"at_s": 40, "agent": 1}]},
            fates=[{"message": "Commit Block", "sender": 3, "count": 1, "drop": True}],
            timeline=[{"at_s": 30, "pause": [3]}],
            final_reconcile=True,
        ),
        seed=1,
        tracing=True,
    )
    assert run.result.figures["reconciles"]
    assert run.result.bad == ()
    assert "and during which all agents were running" in run.result.characteristics["5"].reason


def test_uniform_time_is_known_if_all_chains_are_equal() -> None:
    """The time is that of the last change of a chain. It is known with and without traces."""
    for seed in range(5):
        play = scenario(agents=5, duration_s=600, network={"loss": 0.15}, final_reconcile=True)
        plain, traced = (simulate(play, seed, tracing=tracing) for tracing in (False, True))
        uniform_at_s = plain.result.figures["uniform_at_s"]
        assert uniform_at_s == traced.result.figures["uniform_at_s"]
        assert uniform_at_s == max(round(trace.chain_changed_at(), 3) for trace in traced.evidence.traces.values())
    assert simulate(in_step(blocks=1), seed=1).result.figures["uniform_at_s"] is None


@pytest.mark.lab
@pytest.mark.any_user
def test_cycle_of_processes_is_found_in_traces(tmp_path: Path) -> None:
    """All agents reject every block. Each vote of the only agent with a block therefore ends in a reconcile."""
    refusing = write_scenario(
        tmp_path,
        agents=2,
        duration_s=30,
        speedup=20,
        vehicles={"kind": "none"},
        events={"source": "random", "mean_s": 5},
        quirks={"disapprove_everything": True},
        settle={"limit_s": 180},
    )
    done = harness("run", refusing, "--seed", 37, "--out", tmp_path / "run")  # only agent 1 completes a block
    assert done.returncode == 1, done.stdout + done.stderr
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["liveness"]["verdict"] == "never finishes"
    assert re.fullmatch(
        r"agent 1 has repeated the same cycle since \d+ s: the same handler runs follow each other every 2\d[.\d]* s, "
        r"\d"
        r" times in a row; agent 2 refuses the blocks of agent 1",
        record["liveness"]["reason"],
    )
    assert not record["cycle"]["proven"]
    assert record["cycle"]["periods"] >= 5
    assert (tmp_path / "run" / "report.html").read_text().count('class="round"') >= 5
