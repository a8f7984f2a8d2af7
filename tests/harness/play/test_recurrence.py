"""A swarm in virtual time that goes round in circles is seen to, and the run stops there."""

from typing import Any

import pytest

from harness.archive.run_record import Cycle
from harness.play.simulation.simulation import Simulation
from harness.run.simulate import Simulated, simulate
from harness.scenario import Scenario
from tests.harness.virtual import scenario

PHASE_1_ENDS = "reconcile_phase_1_timer_expiration"
VOTE_ENDS = "vote_timer_expiration"


def in_step(agents: int = 5, blocks: int = 2, **keys: Any) -> Scenario:
    """Every agent completes so many blocks in the same instants."""
    events = [
        {"at_s": 1.0 + block, "agent": agent, "bytes": 256}
        for block in range(blocks)
        for agent in range(1, agents + 1)
        for _ in range(4)
    ]
    return scenario(agents=agents, duration_s=60, events={"source": "scripted", "script": events}, **keys)


def the_cycle(simulated: Simulated) -> Cycle:
    cycle = simulated.played.cycle
    assert cycle is not None
    return cycle


NETWORKS: list[dict[str, Any]] = [{}, {"delay": 0.01}, {"delay": {"mean_s": 0.5, "jitter_s": 0.4}}, {"delay": 0}]


@pytest.mark.parametrize("network", NETWORKS)
def test_agents_that_reconcile_in_step_do_so_for_ever_and_the_run_stops(network: dict[str, Any]) -> None:
    run = simulate(in_step(network=network), seed=1)
    cycle = the_cycle(run)
    assert not run.played.settled
    assert run.played.mission_s < 300, "it does not play the half hour that agents may take to finish"
    assert (cycle.period_s, cycle.proven, cycle.agents) == (15.0, True, [1, 2, 3, 4, 5])
    assert {(step.agent_id, step.handler) for step in cycle.steps} == {
        (agent, handler) for agent in range(1, 6) for handler in (PHASE_1_ENDS, VOTE_ENDS)
    }
    assert {wait.agent_id: wait.for_agents for wait in cycle.waits} == {
        agent: [peer for peer in range(1, 6) if peer != agent] for agent in range(1, 6)
    }


def test_what_was_seen_is_the_same_traced_or_not_and_whatever_is_delivered() -> None:
    plain, traced, everything = (
        the_cycle(simulate(in_step(), seed=3, tracing=tracing, deliver_all=deliver_all))
        for tracing, deliver_all in ((False, False), (True, False), (True, True))
    )
    assert plain == traced == everything


def test_a_cycle_goes_on_for_ever_indeed(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = simulate(in_step(), seed=1)
    monkeypatch.setattr(Simulation, "_looks_for_recurrence", lambda simulation: None)
    played_out = simulate(in_step(), seed=1)
    assert played_out.played.mission_s == 60 + 1800
    assert played_out.result.figures["reconciles"] > 9 * stopped.result.figures["reconciles"]
    first, last = (
        {agent: export.chain_of_block_hashes for agent, export in run.evidence.exports.items()}
        for run in (stopped, played_out)
    )
    assert first == last


def test_a_final_reconcile_that_goes_round_stops_as_well() -> None:
    run = simulate(in_step(final_reconcile=True), seed=1)
    assert run.played.final_reconcile is not None
    assert not run.played.final_reconcile.complete
    assert the_cycle(run).since_s > run.played.final_reconcile.at_s


@pytest.mark.parametrize(
    "chance",
    [
        {"network": {"loss": 0.1}},
        {"network": {"delay": 0.01, "reorder": 0.1}},
        {"quirks": {"ignore_commit": 0.5}},
        {"timeline": [{"at_s": 2, "flood": {"for_s": 1, "per_s": 1}}]},
    ],
)
def test_nothing_is_proven_where_lots_decide(chance: dict[str, Any]) -> None:
    for seed in range(5):
        assert simulate(in_step(**chance), seed).played.cycle is None


def test_a_swarm_that_becomes_idle_goes_round_in_no_circle() -> None:
    for seed in range(20):
        run = simulate(scenario(agents=5, duration_s=600, network={"loss": 0.15}, final_reconcile=True), seed)
        assert run.played.cycle is None


def test_an_agent_that_hangs_is_a_standstill() -> None:
    """With one of the field test's faults a tie leaves a reconcile that no timer ends."""
    hanging = [
        run
        for seed in range(20)
        if not (
            run := simulate(
                scenario(agents=4, duration_s=900, network={"loss": 0.3}, quirks={"crash_on_tie": True}), seed
            )
        ).played.settled
    ]
    assert hanging
    for run in hanging:
        cycle = the_cycle(run)
        assert "period_s" not in cycle
        busy = [agent_id for agent_id, export in run.evidence.exports.items() if not export.idle]
        assert cycle.agents == busy


def test_who_is_looked_at_twice_in_the_same_wait_has_not_come_again() -> None:
    """A hunt found that: it was said to go round every 0 s, and was done 15 s later."""
    script = [(1, 1), (1, 3), (7, 2), (11, 3), (12, 1), (27, 2), (32, 3)]
    run = simulate(
        scenario(
            agents=3,
            duration_s=33,
            network={"delay": 0.02},
            clocks={1: {"offset_s": 300}},
            settings={"max_block_bytes": 267},
            timeline=[{"at_s": 2, "partition": [[2], [1, 3]], "for_s": 18}],
            events={"source": "scripted", "script": [{"at_s": at_s, "agent": agent} for at_s, agent in script]},
            fates=[
                {"message": "Chain Contain Response", "sender": 2, "receiver": 1, "count": 2, "drop": True},
                {"message": "Block Response", "sender": 2, "receiver": 3, "count": 1, "drop": True},
                {"message": "Chain Contain Query", "sender": 2, "receiver": 3, "count": 2, "drop": True},
            ],
        ),
        seed=34692,
        tracing=True,
    )
    assert run.played.cycle is None
    assert run.result.judgements["liveness"].verdict == "finished"


@pytest.mark.parametrize(("late", "proven"), [("2+0.001", True), ("2+0.001 9000+1", False)])
def test_timers_that_were_told_to_be_late_prove_nothing_only_until_they_have_ended(late: str, proven: bool) -> None:
    run = simulate(in_step(lateness={1: late}, network={"delay": 0.01}), seed=1)
    assert not run.played.settled
    assert (run.played.cycle is not None) == proven
