"""Test the conditions of endless cycles, and that the simulation confirms the cycles."""

from pathlib import Path

import pytest

from harness.archive.run_record import Cycle
from harness.proof import Bounds, ExplorationProgress, in_words, prove
from harness.proof._progress_bar import ExplorationBudget
from harness.proof.examples._example import ViolationExample
from harness.proof.graph._exploration import explore
from harness.proof.model._global_states import AGENTS, BLOCKS, ZONE, ModelSwarm
from harness.proof.model._instant import AgentAction
from harness.proof.model._zones import NOTHING_RUNS, ZoneTable
from harness.proof.questions._extra_votes import ExtraVotes
from harness.proof.questions._graph_cycles import cycles
from harness.proof.questions._livelock import Livelock, show
from tests.harness.proof.test_explore import explored


@pytest.mark.parametrize(("blocks", "network"), [(4, "lossless"), (3, "lossy")])
def test_each_form_becomes_a_scenario_with_a_livelock(tmp_path: Path, blocks: int, network: str) -> None:
    proof = prove(Bounds(2, blocks, network), out=tmp_path / "round.yaml")  # type: ignore[arg-type]
    assert proof.liveness is not None
    (livelock,) = proof.livelocks
    assert livelock.ways == len(proof.liveness.cycles) > 1
    assert livelock.coincidences == 1
    assert livelock.example.judged["liveness"].verdict == "never finishes"
    assert livelock.cycle is not None
    assert livelock.cycle.period_s == pytest.approx(15.0)
    assert livelock.cycle.agents == [1, 2]
    assert {"vote_timer_expiration", "reconcile_finalize"} <= {step.handler for step in livelock.cycle.steps}
    assert any("two instants are equal by chance" in line for line in in_words(proof))


@pytest.mark.parametrize(
    ("coincidences", "losses", "goes_round", "contradictory", "expected"),
    [
        (0, 0, True, False, "which needs no coincidence"),
        (0, 1, True, False, "which needs no coincidence; 1 loss leads there"),
        (0, 3, False, False, "arrive in the same order in every round; 3 losses lead there"),
        (2, 0, True, False, "2 times two instants are equal by chance"),
        (0, 0, False, True, "as no clocks make them go"),
        (None, 0, False, False, "if timers can expire in this order"),
    ],
)
def test_livelock_reports_its_conditions(
    tmp_path: Path, coincidences: int | None, losses: int, goes_round: bool, contradictory: bool, expected: str
) -> None:
    cycle = Cycle(since_s=1.0, period_s=15.0, agents=[1]) if goes_round else None
    example = ViolationExample(tmp_path / "x.yaml", 1, {}, 1)
    assert expected in Livelock(1, coincidences, (), example, losses, cycle, contradictory).in_words()


def test_possible_forms_come_first_and_the_rest_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = explored(4, 4, "lossless", clocks_any=True)
    ways = [*cycles(graph)]
    for number, each in enumerate((ways, ways[::-1])):
        shown = [livelock.contradictory for livelock in show(graph, each, tmp_path / f"{number}.yaml", "round")]
        assert shown == [False, True]
    monkeypatch.setattr("harness.proof.questions._livelock.MAX_FORMS", 1)
    proof = prove(Bounds(4, 4, "lossless", clocks_any=True), out=tmp_path / "some.yaml")
    assert [livelock.contradictory for livelock in proof.livelocks] == [False]
    assert "  1 more, of other forms, was not played" in [*in_words(proof)]


def test_cycle_is_found_in_an_incomplete_graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(progress: ExplorationProgress) -> None:
        if progress.looked_at >= 500:
            monkeypatch.setattr(ExplorationBudget, "ended", lambda *_: "time")

    proof = prove(Bounds(2, 4, "lossless"), out=tmp_path / "round.yaml", watch=stop)
    assert (proof.ended, proof.liveness, proof.exit_status) == ("time", None, 1)
    assert proof.livelocks
    assert [line[0] for line in in_words(proof) if "one chain:" in line or "livelock:" in line] == ["-", "✘"]


def test_only_one_block_of_the_livelock_has_a_fixed_time(tmp_path: Path) -> None:
    """The first blocks of both agents must be completed directly after each other. The other blocks may be completed at
    any time before the vote is decided.
    """
    proof = prove(Bounds(2, 4, "lossless"), out=tmp_path / "round.yaml")
    completions = proof.livelocks[0].completions
    assert sorted(completion.agent for completion in completions) == [1, 1, 2, 2]
    assert sum(completion.earliest_s == completion.latest_s for completion in completions) == 2
    assert max(completion.latest_s for completion in completions) == 10.0


def test_livelock_with_timers_any_has_no_number_of_coincidences(tmp_path: Path) -> None:
    proof = prove(Bounds(2, 4, "lossless", timers_any=True), out=tmp_path / "any.yaml")
    assert proof.livelocks[0].coincidences is None
    assert any("one of them may wait for ever" in line for line in in_words(proof))


def test_no_livelock_exists_without_coincidences(tmp_path: Path) -> None:
    proof = prove(Bounds(2, 4, "lossless", coincidences=0), out=tmp_path / "none.yaml")
    assert proof.exit_status == 0
    assert proof.liveness is not None
    assert not proof.liveness.cycles
    assert not proof.liveness.forks


def test_one_more_vote_is_enough_for_three_agents_and_two_blocks(tmp_path: Path) -> None:
    """If two timers expire at the same moment, either may be handled first. Only for this reason, one more vote is
    enough.
    """
    proof = prove(Bounds(3, 2, "lossy"), out=tmp_path / "three.yaml")
    assert proof.liveness is not None
    assert proof.liveness.lost is proof.reluctant is None
    assert proof.liveness.astray == [68, 0]


def test_state_that_needs_two_votes_becomes_a_scenario(tmp_path: Path) -> None:
    proof = prove(Bounds(4, 2, "lossy"), out=tmp_path / "four.yaml")
    assert proof.liveness is not None
    assert proof.liveness.astray[1:] == [1, 0]
    assert proof.reluctant is not None
    assert (proof.reluctant.path.name, proof.reluctant.chains) == ("four_votes.yaml", 3)
    assert any("needs more than one vote" in line for line in in_words(proof))


def test_single_path_gives_the_result_of_all_successors(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = explore(ModelSwarm(Bounds(4, 2, "lossy")), most_bytes=8e9, most_s=600)
    forks = [state for state in graph.states if graph.swarm.is_idle(state) and len(graph.swarm.chains(state)) > 1]
    lazy = ExtraVotes(graph.swarm)
    needed = [lazy.needed(fork) for fork in forks]
    assert {*needed} == {1, 2}
    monkeypatch.setattr(ExtraVotes, "_find_path", lambda *_: False)
    thorough = ExtraVotes(graph.swarm)
    assert [thorough.needed(fork) for fork in forks] == needed


def test_coincidence_is_an_open_difference_of_two_times() -> None:
    zones = ZoneTable()
    ten_s = -10_000_000 - 1
    first = zones.after(NOTHING_RUNS, (), (ten_s,))
    assert first is not None
    both = zones.after(first, (), (1, ten_s))
    assert both is not None
    assert zones.coincidences(both, (1,)) == 0
    assert zones.coincidences(both, (2,)) == 1
    assert zones.coincidences(both, (1, 2)) == 1
    at_once = zones.after(NOTHING_RUNS, (), (ten_s, ten_s))
    assert at_once is not None
    assert zones.coincidences(at_once, (1, 2)) == 0


def test_block_between_two_simultaneous_timers_is_a_coincidence() -> None:
    free, none = explored(3, 3, "lossy"), explored(3, 3, "lossy", coincidences=0)
    assert len(none.states) < len(free.states)
    between = 0
    for graph, expected in ((free, 1), (none, None)):
        for state in graph.states:
            now = any(row[0] == 0 for row in graph.swarm.zones.matrix(state[ZONE])[1:])
            if now and state[BLOCKS] < 3:
                blocks = [actions for actions in graph.swarm.actions(state) if actions[0].what == "complete"]
                assert bool(blocks) == (expected is not None)
                assert {graph.swarm.coincidences(state, actions) for actions in blocks} <= {expected}
                between += 1
    assert between


def test_fault_or_attack_between_timers_counts_as_a_coincidence() -> None:
    graph = explored(3, 2, "lossy", ("death",))
    swarm, between = graph.swarm, 0
    for state in graph.states:
        now = any(row[0] == 0 for row in swarm.zones.matrix(state[ZONE])[1:])
        between += now
        for place in range(len(state[AGENTS:])):
            assert swarm.coincidences(state, (AgentAction(place, "death"),)) == now
            assert swarm.coincidences(state, (AgentAction(place, "captured"),)) == 0
    assert between
