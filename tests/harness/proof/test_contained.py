"""Test explorations with `--zones contained`, in which a state also represents the states whose zones it contains."""

from pathlib import Path
from typing import Any

import pytest

from harness.proof import Bounds, BoundsError, in_words, prove
from harness.proof.graph._expansion import StateStore
from harness.proof.graph._exploration import StateGraph, explore
from harness.proof.model._global_states import ModelSwarm
from harness.proof.questions._convergence import look
from harness.proof.questions._graph_cycles import _cyclic_parts, cycles
from harness.proof.questions._livelock import in_timers
from tests.harness.proof.test_explore import all_seen, explored

STAGGER = {"vote_timeout_s": 0.3, "phase1_timeout_s": 0.15, "phase2_timeout_s": 0.15, "phase3_timeout_s": 0.15}


@pytest.mark.parametrize(
    ("bounds", "fewer"),
    [
        (Bounds(2, 4, "lossless"), 1.1),
        (Bounds(2, 3, "lossy", ("reboot",)), 1.4),
        (Bounds(2, 3, "lossy", stagger={"phase1_timeout_s": 0.5}), 4),
        (Bounds(3, 2, "lossy"), 1),
        (Bounds(2, 2, "lossy", reduced=False), 1),
    ],
    ids=lambda value: value.in_words() if isinstance(value, Bounds) else "",
)
def test_contained_zones_change_no_finding(bounds: Bounds, fewer: float) -> None:
    equal, contained = _explored(bounds), _explored(bounds, zones_contained=True)
    states = len(contained.states)
    assert states * fewer <= len(equal.states)
    assert all_seen(contained) == all_seen(equal)
    found, expected = look(contained), look(equal)
    assert (found.forks, len(found.astray)) == (expected.forks, len(expected.astray))
    assert len(found.cycles) == len(expected.cycles)
    assert in_timers(contained, found.cycles) == in_timers(equal, expected.cycles)


def _explored(bounds: Bounds, **changes: Any) -> StateGraph:
    return explored(**{**vars(bounds), **changes})


def test_state_represents_states_with_contained_zones_only() -> None:
    states = StateStore(agents=2, contains=lambda zone, other: zone >= other)
    assert [states.add((0, 0, zone, 1, 2)) for zone in (5, 3, 7, 6, 5)] == [0, 0, 1, 1, 0]
    assert states.add((0, 0, 3, 2, 1)) == 2
    assert states.append((0, 0, 3, 1, 2)) == 3


def test_larger_zone_contains_the_smaller_one() -> None:
    zones = ModelSwarm(Bounds()).zones
    wide, narrow = zones.adopt(((0, 0), (10, 0))), zones.adopt(((0, -2), (5, 0)))
    assert zones.contains(wide, narrow)
    assert not zones.contains(narrow, wide)


def test_cycle_whose_times_shift_is_no_livelock() -> None:
    """The times of the two agents shift in each round. The graph has a cycle, but no run repeats this cycle forever."""
    swarm = ModelSwarm(Bounds(2, 3, "lossy", stagger=STAGGER, clocks_any=True, zones_contained=True))
    graph = explore(swarm, most_bytes=8e9, most_s=600)
    assert [*_cyclic_parts(graph, lambda: None)]
    assert [*cycles(graph)] == []


def test_livelock_among_contained_zones_is_played(tmp_path: Path) -> None:
    proof = prove(Bounds(2, 4, "lossless", zones_contained=True), out=tmp_path / "round.yaml")
    assert proof.exit_status == 1
    [livelock] = proof.livelocks
    assert livelock.cycle is not None
    assert "contained zones left out" in next(in_words(proof))
    assert proof.to_json()["zones_contained"] is True


def test_missing_path_to_one_chain_stays_undecided(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    proof = prove(Bounds(3, 2, "lossy", zones_contained=True), out=tmp_path / "chain.yaml")
    assert proof.exit_status == 0
    assert proof.liveness is not None
    monkeypatch.setattr(proof.liveness, "lost", 5)
    assert (proof.exit_status, proof.findings) == (4, {})
    assert any(line.startswith("- not decided, one chain") and "--zones equal" in line for line in in_words(proof))


def test_timers_in_any_order_have_no_zones() -> None:
    with pytest.raises(BoundsError, match="--zones contained"):
        Bounds(2, 2, "lossy", timers_any=True, zones_contained=True)
