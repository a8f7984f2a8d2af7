"""Test the option `--clocks any`, with which any block may be the older one. States that differ only in the identity of
blocks then count as one state.
"""

from collections.abc import Iterator, Sequence
from itertools import permutations
from pathlib import Path
from random import Random
from typing import Any

import pytest

from harness.proof import Bounds, prove
from harness.proof.examples._path_script import PathScript
from harness.proof.examples._path_times import BlockAges
from harness.proof.graph._exploration import StateGraph, explore
from harness.proof.model._global_states import AGENTS, ModelSwarm
from harness.run.simulate import simulate
from harness.scenario.load import parse
from tests.harness.proof.test_explore import Seen, all_seen, by_chance, explored


def alike(seen: Seen) -> Seen:
    """Return one view to represent all views that differ only in the identity of agents and blocks."""
    return min(tuple(sorted(called)) for called in renumbered(seen))


def renumbered(seen: Seen) -> Iterator[Seen]:
    """Yield all views that differ from this view only in the identity of blocks."""
    there = sorted({block for agent in seen for held in agent[:3] for block in held})

    def called(order: Sequence[int]) -> Seen:
        names = dict(zip(there, order, strict=True))

        def each(blocks: tuple[int, ...]) -> tuple[int, ...]:
            return tuple(names[block] for block in blocks)

        return tuple((each(chain), each(deque), each(stack), *rest) for chain, deque, stack, *rest in seen)

    yield from (called(order) for order in permutations(range(1, len(there) + 1)))


def all_alike(graph: StateGraph) -> set[Seen]:
    return {alike(seen) for seen in all_seen(graph)}


@pytest.mark.parametrize(
    ("agents", "blocks", "network", "faults"),
    [(2, 3, "lossless", ()), (2, 2, "lossy", ("reboot",)), (3, 2, "lossless", ("death",))],
)
def test_reduced_and_whole_state_spaces_are_equal(
    agents: int, blocks: int, network: Any, faults: tuple[str, ...]
) -> None:
    reduced = explored(agents, blocks, network, faults, clocks_any=True)
    whole = explored(agents, blocks, network, faults, clocks_any=True, reduced=False)
    assert len(reduced.states) < len(whole.states)
    assert all_alike(reduced) == all_alike(whole)
    assert {*map(len, map(reduced.swarm.chains, reduced.states))} == {*map(len, map(whole.swarm.chains, whole.states))}


def test_states_with_equal_clocks_are_contained() -> None:
    agreed, any_older = explored(3, 3, "lossy"), explored(3, 3, "lossy", clocks_any=True)
    assert len(any_older.states) < len(agreed.states) / 3
    assert all_alike(agreed) <= all_alike(any_older)


@pytest.mark.parametrize(("agents", "blocks", "loss"), [(2, 3, 0.4), (3, 3, 0.4), (3, 3, 0.0)])
def test_runs_with_different_clocks_are_contained(agents: int, blocks: int, loss: float) -> None:
    seen = all_alike(explored(agents, blocks, "lossy" if loss else "lossless", clocks_any=True))
    for seed in range(40):
        for there in by_chance(agents, blocks, loss, Random(seed), clocks_apart=True):
            assert alike(there) in seen


def test_tie_for_the_younger_block_is_played_with_timestamps() -> None:
    graph = explored(3, 3, "lossy", clocks_any=True)
    at_rest = [number for number, state in enumerate(graph.states) if number and graph.swarm.is_idle(state)]
    played = 0
    for number in at_rest:
        script = PathScript(graph, graph.path(number))
        document = script.document("younger")
        if "timestamp_us" in document["events"]["script"][0]:
            assert not script.contradictory
            chains = simulate(parse(document), 1, tracing=True).result.chains.values()
            expected = [graph.swarm.local.known[local].chain for local in graph.states[number][AGENTS:]]
            assert sorted(map(len, chains)) == sorted(map(len, expected))
            assert len({*chains}) == len({*expected})
            played += 1
    assert played


def test_without_clocks_any_the_older_block_is_fixed() -> None:
    graph = explored(3, 3, "lossy", clocks_any=True)
    several = 0
    for number, state in enumerate(graph.states):
        alternatives = [*graph.swarm.alternatives(state)]
        timers = {(first.place, first.number) for first, _ in alternatives}
        assert len(graph.quiet[number]) == len(alternatives) >= len(timers)
        several += len(alternatives) > len(timers)
        for first, together in alternatives:
            assert first in together
            assert len({action.place for action in together}) <= len(together)
            assert len({action[:3] for action in together}) == len(together), "of each tie one way"
    assert several


def test_contradictory_ties_are_reported(tmp_path: Path) -> None:
    proof = prove(Bounds(4, 4, "lossless", clocks_any=True), out=tmp_path / "four.yaml")
    said = [livelock.in_words() for livelock in proof.livelocks]
    assert [livelock.contradictory for livelock in proof.livelocks] == [False, True]
    assert "as no clocks make them go" in said[1]
    assert "as no clocks make them go" in proof.livelocks[1].example.path.read_text()
    assert proof.livelocks[0].cycle is not None


def test_ages_give_timestamps_in_the_required_order() -> None:
    ages = BlockAges()
    for ordinal in (1, 2, 3):
        ages.completed(ordinal)
    ages.renumber((3, 1))  # the third block becomes 1, the first 2, and the second 3
    ages.require_older(1, [2])
    events: list[dict[str, Any]] = [{"at_s": float(number), "agent": number} for number in (1, 2, 3)]
    assert ages.date(events)
    assert events[2]["timestamp_us"] < events[0]["timestamp_us"]
    assert sorted(event["timestamp_us"] for event in events) == [1_000_000, 2_000_000, 3_000_000]
    ages.require_older(2, [1])
    assert not ages.date(events)


def test_clock_of_an_agent_does_not_go_back() -> None:
    ages = BlockAges()
    ages.completed(1)
    ages.completed(2)
    ages.require_older(2, [1])
    assert not ages.date([{"at_s": 1.0, "agent": 7}, {"at_s": 2.0, "agent": 7}])


def test_more_coincidences_give_more_states() -> None:
    bounded = [explored(2, 4, "lossless", coincidences=most) for most in (0, 1, 9)]
    seen = [all_seen(graph) for graph in bounded]
    assert seen[0] < seen[1] < seen[2] == all_seen(explored(2, 4, "lossless"))


def test_livelock_needs_its_number_of_coincidences(tmp_path: Path) -> None:
    free = prove(Bounds(2, 4, "lossless"), out=tmp_path / "free.yaml")
    least = min(livelock.coincidences for livelock in free.livelocks if livelock.coincidences is not None)
    assert least > 0
    for most, found in ((least - 1, False), (least, True)):
        swarm = ModelSwarm(Bounds(2, 4, "lossless", coincidences=most))
        assert explore(swarm, most_bytes=8e9, most_s=600).ended == "complete"
        proof = prove(swarm.bounds, out=tmp_path / f"{most}.yaml")
        assert bool(proof.livelocks) == found
