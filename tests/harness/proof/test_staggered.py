"""Test agents whose timers have different durations. Such agents are not interchangeable."""

from pathlib import Path
from random import Random
from typing import Any

import pytest

from harness.proof import Bounds, prove
from harness.proof.examples._path_script import PathScript
from harness.proof.graph._exploration import StateGraph
from harness.proof.model._global_states import AGENTS
from harness.run.simulate import simulate
from harness.scenario.agent_options import Stagger
from harness.scenario.load import parse
from tests.harness.proof.test_blocks import alike, all_alike, renumbered
from tests.harness.proof.test_explore import Seen, by_chance, by_place, explored

PHASE_1: Stagger = {"phase1_timeout_s": 0.5}


def whichever_block(graph: StateGraph) -> set[Seen]:
    """Return one view to represent all views that differ only in the identity of blocks."""
    return {min(renumbered(seen)) for seen in by_place(graph)}


@pytest.mark.parametrize(
    ("agents", "blocks", "network", "faults", "stagger"),
    [
        (2, 3, "lossless", (), PHASE_1),
        (2, 2, "lossy", ("reboot",), {"vote_timeout_s": 0.5}),
        (3, 2, "lossless", ("death",), PHASE_1),
    ],
)
@pytest.mark.parametrize("any_older", [False, True])
def test_reduced_and_whole_state_spaces_are_equal(
    agents: int, blocks: int, network: Any, faults: tuple[str, ...], stagger: Stagger, any_older: bool
) -> None:
    reduced = explored(agents, blocks, network, faults, stagger=stagger, clocks_any=any_older)
    whole = explored(agents, blocks, network, faults, stagger=stagger, clocks_any=any_older, reduced=False)
    assert len(reduced.states) < len(whole.states)
    look = whichever_block if any_older else by_place
    assert look(reduced) == look(whole)
    assert {*map(len, map(reduced.swarm.chains, reduced.states))} == {*map(len, map(whole.swarm.chains, whole.states))}


@pytest.mark.parametrize("loss", [0.0, 0.4])
def test_random_runs_are_contained(loss: float) -> None:
    seen = all_alike(explored(3, 2, "lossy" if loss else "lossless", stagger=PHASE_1, clocks_any=True))
    for seed in range(40):
        for there in by_chance(3, 2, loss, Random(seed), clocks_apart=True, stagger=PHASE_1):
            assert alike(there) in seen


def test_renaming_of_blocks_reduces_the_state_space() -> None:
    agreed = explored(3, 2, "lossy", stagger=PHASE_1)
    any_older = explored(3, 2, "lossy", stagger=PHASE_1, clocks_any=True)
    assert len(any_older.states) < len(agreed.states)
    assert whichever_block(agreed) <= whichever_block(any_older)


def test_path_to_an_idle_swarm_is_played_by_the_right_agents() -> None:
    graph = explored(2, 3, "lossy", stagger=PHASE_1, clocks_any=True)
    at_rest = [number for number, state in enumerate(graph.states) if number and graph.swarm.is_idle(state)]
    played = 0
    for number in at_rest:
        script = PathScript(graph, graph.path(number))
        document = script.document("staggered")
        if not script.contradictory:
            chains = simulate(parse(document), 1, tracing=True).result.chains
            expected = [graph.swarm.local.known[local].chain for local in graph.states[number][AGENTS:]]
            assert [len(chain) for _, chain in sorted(chains.items())] == [*map(len, expected)]
            assert len({*chains.values()}) == len({*expected})
            played += 1
    assert played > 10


def test_cure_holds_with_clocks_any(tmp_path: Path) -> None:
    """Two agents act at the same times. With the timers of the thesis, these agents have an endless cycle."""
    bounds = Bounds(2, 4, "lossless", clocks_any=True)
    assert prove(bounds, out=tmp_path / "thesis.yaml").livelocks
    cured = prove(Bounds(2, 4, "lossless", clocks_any=True, stagger=PHASE_1), out=tmp_path / "cured.yaml")
    assert cured.exit_status == 0
    assert not cured.livelocks
