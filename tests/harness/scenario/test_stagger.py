"""Test timers whose duration increases from agent to agent."""

from dataclasses import replace
from typing import Any

import pytest

from docs.generate.cures import STAGGER
from harness.checker.records import _headers
from harness.errors import ScenarioError
from harness.proof import Bounds, BoundsError
from harness.proof.graph._exploration import explore
from harness.proof.model._global_states import ModelSwarm
from harness.proof.questions._convergence import look
from harness.run.simulate import simulate
from harness.scenario._network import NetworkModel
from harness.scenario.agent_options import Stagger
from harness.scenario.load import load_scenario, parse
from tests.harness.play.test_recurrence import in_step
from tests.harness.scenario.test_scenarios import SCENARIOS


def test_each_agent_gets_its_own_timers_and_records_agree() -> None:
    document = {"name": "a", "agents": [3, 7, 9], "duration_s": 100, "stagger": {"vote_timeout_s": 0.5}}
    simulated = simulate(parse(document), 1, tracing=True)
    timers = {
        agent_id: trace.header.settings["vote_timeout_s"] for agent_id, trace in simulated.evidence.traces.items()
    }
    assert timers == {3: 10.0, 7: 10.5, 9: 11.0}
    assert not simulated.result.bad
    trace = simulated.evidence.traces[7]
    trace.header.settings["vote_timeout_s"] = 10.0
    assert len([*_headers.compare_headers(simulated.evidence)]) == 1


def test_stagger_ends_the_livelock_of_agents_in_step() -> None:
    scenario = in_step()
    assert simulate(scenario, 1).result.judgements["liveness"].verdict == "never finishes"
    for timer in ("vote_timeout_s", "phase1_timeout_s"):
        staggered = scenario.model_copy(update={"stagger": {timer: 0.5}})
        assert simulate(staggered, 1).result.judgements["liveness"].verdict == "finished"


def test_two_losses_livelock_a_staggered_swarm() -> None:
    """The scenario loses two messages. The agents do not repeat a cycle if only one of these messages is lost, if all
    timers are equal, or with the setting `top_needs_majority`.
    """
    scenario = load_scenario(SCENARIOS / "two_losses.yaml")
    first, second = scenario.fates

    def liveness(seed: int = 1, **changes: Any) -> str:
        return simulate(scenario.model_copy(update=changes), seed).result.judgements["liveness"].verdict

    assert {liveness(seed, network=NetworkModel()) for seed in range(8)} == {"never finishes"}
    assert liveness() == "never finishes"
    assert liveness(fates=[first]) == liveness(fates=[second]) == liveness(stagger={}) == "finished"
    majority = replace(scenario.settings, top_needs_majority=True)
    assert liveness(settings=majority) == "finished"


def test_staggered_phase_1_alone_allows_a_livelock_in_resonance() -> None:
    """Set only the timers of phase 1 to different durations. Twice the phase 1 of one agent then takes as long as
    phases 1 and 3 of another agent, for any difference of the timers.
    """
    scenario = load_scenario(SCENARIOS / "in_resonance.yaml")

    def liveness(seed: int = 1, **changes: Any) -> str:
        return simulate(scenario.model_copy(update=changes), seed, tracing=True).result.judgements["liveness"].verdict

    assert {liveness(seed, network=NetworkModel()) for seed in range(8)} == {"never finishes"}
    assert {liveness(stagger={"phase1_timeout_s": step_s}) for step_s in (0.4, 0.6, 1.0)} == {"never finishes"}
    assert liveness(stagger={}) == liveness(stagger=STAGGER) == "finished"
    for fate in scenario.fates:
        assert liveness(fates=[one for one in scenario.fates if one is not fate]) == "finished"


@pytest.mark.parametrize("stagger", [{"vote_timeout_s": 0.5}, {"phase1_timeout_s": 0.5}, STAGGER])
def test_stagger_leaves_no_livelock_within_bounds(stagger: Stagger) -> None:
    graph = explore(ModelSwarm(Bounds(2, 3, "lossy", stagger=stagger)), most_bytes=4e9, most_s=600)
    assert graph.ended == "complete"
    assert not look(graph).cycles


def test_invalid_stagger_is_refused() -> None:
    with pytest.raises(ScenarioError, match="the last agent's vote_timeout_s"):
        parse({"name": "a", "agents": 5, "stagger": {"vote_timeout_s": 9e8}})
    with pytest.raises(BoundsError, match="--stagger must be seconds"):
        Bounds(stagger={"max_block_bytes": 1})  # type: ignore[dict-item]
