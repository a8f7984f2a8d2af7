"""Test that a simulated run ends when its swarm repeats a cycle that never ends."""

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
    """Return a scenario in which all agents complete their blocks at the same times."""
    events = [
        {"at_s": 1.0 + block, "agent": agent, "bytes": 256}
        for block in range(blocks)
        for agent in range(1, agents + 1)
        for _ in range(4)
    ]
    return scenario(agents=agents, duration_s=60, events={"source": "scripted", "script": events}, **keys)


def cycle_of(simulated: Simulated) -> Cycle:
    cycle = simulated.played.cycle
    assert cycle is not None
    return cycle


NETWORKS: list[dict[str, Any]] = [{}, {"delay": 0.01}, {"delay": {"mean_s": 0.5, "jitter_s": 0.4}}, {"delay": 0}]


@pytest.mark.parametrize("network", NETWORKS)
def test_run_stops_when_agents_reconcile_in_step_forever(network: dict[str, Any]) -> None:
    run = simulate(in_step(network=network), seed=1)
    cycle = cycle_of(run)
    assert not run.played.settled
    assert run.played.mission_s < 300, "the run stops before the settling limit of half an hour"
    assert (cycle.period_s, cycle.proven, cycle.agents) == (15.0, True, [1, 2, 3, 4, 5])
    assert {(step.agent_id, step.handler) for step in cycle.steps} == {
        (agent, handler) for agent in range(1, 6) for handler in (PHASE_1_ENDS, VOTE_ENDS)
    }
    assert {wait.agent_id: wait.for_agents for wait in cycle.waits} == {
        agent: [peer for peer in range(1, 6) if peer != agent] for agent in range(1, 6)
    }


def test_tracing_and_deliveries_do_not_change_the_cycle() -> None:
    plain, traced, everything = (
        cycle_of(simulate(in_step(), seed=3, tracing=tracing, deliver_all=deliver_all))
        for tracing, deliver_all in ((False, False), (True, False), (True, True))
    )
    assert plain == traced == everything


def test_cycle_continues_until_the_limit_without_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = simulate(in_step(), seed=1)
    monkeypatch.setattr(Simulation, "_new_recurrence", lambda simulation: None)
    played_out = simulate(in_step(), seed=1)
    assert played_out.played.mission_s == 60 + 1800
    assert played_out.result.figures["reconciles"] > 9 * stopped.result.figures["reconciles"]
    first, last = (
        {agent: export.chain_of_block_hashes for agent, export in run.evidence.exports.items()}
        for run in (stopped, played_out)
    )
    assert first == last


def test_cycle_in_a_final_reconcile_ends_the_run() -> None:
    run = simulate(in_step(final_reconcile=True), seed=1)
    assert run.played.final_reconcile is not None
    assert not run.played.final_reconcile.complete
    assert cycle_of(run).since_s > run.played.final_reconcile.at_s


@pytest.mark.parametrize(
    "chance",
    [
        {"network": {"loss": 0.1}},
        {"network": {"delay": 0.01, "reorder": 0.1}},
        {"quirks": {"ignore_commit": 0.5}},
        {"timeline": [{"at_s": 2, "flood": {"for_s": 1, "per_s": 1}}]},
    ],
)
def test_random_draws_prevent_the_proof_of_a_cycle(chance: dict[str, Any]) -> None:
    for seed in range(5):
        assert simulate(in_step(**chance), seed).played.cycle is None


def test_idle_swarm_is_in_no_cycle() -> None:
    for seed in range(20):
        run = simulate(scenario(agents=5, duration_s=600, network={"loss": 0.15}, final_reconcile=True), seed)
        assert run.played.cycle is None


def test_hanging_agent_is_reported_without_a_period() -> None:
    """After a tie, an agent with the error `crash_on_tie` stays in its reconcile forever."""
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
        cycle = cycle_of(run)
        assert "period_s" not in cycle
        busy = [agent_id for agent_id, export in run.evidence.exports.items() if not export.idle]
        assert cycle.agents == busy


def test_two_checks_at_the_same_time_are_no_cycle() -> None:
    """A random search found this run. The harness reported a cycle of 0 s, although the swarm was idle 15 s later."""
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
def test_late_timers_prevent_a_proof_until_they_have_ended(late: str, proven: bool) -> None:
    run = simulate(in_step(lateness={1: late}, network={"delay": 0.01}), seed=1)
    assert not run.played.settled
    assert (run.played.cycle is not None) == proven
