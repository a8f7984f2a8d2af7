"""Test an agent whose blocks all other agents reject: the conditions of its endless cycle, and the corrections."""

from typing import Any

import pytest

from harness.proof import Bounds
from harness.proof.graph._exploration import explore
from harness.proof.questions import _convergence
from harness.proof.questions._convergence import ConvergenceResult
from tests.harness.proof.forked import forked

THESIS: dict[str, Any] = {}
BLOCK = {"settings": {"phase2_tie": "block"}}
MAJORITY = {"settings": {"top_needs_majority": True}}
STAGGER = {"stagger": {"phase1_timeout_s": 0.5}}


def after_the_fork(agents: int, holders: list[int], keys: dict[str, Any]) -> ConvergenceResult:
    """Explore a swarm with diverged chains and no losses, in which agents complete blocks at any time. Return the
    result.
    """
    bounds = Bounds(agents, len(holders) + 1, "lossless", **keys)
    graph = explore(forked(bounds, holders), most_bytes=8e9, most_s=300)
    assert graph.ended == "complete"
    return _convergence.look(graph)


@pytest.mark.parametrize(
    ("agents", "holders", "keys", "goes_round"),
    [
        pytest.param(3, [1, 1], THESIS, False, id="two to one is a majority"),
        pytest.param(4, [1, 1], THESIS, True, id="two to two"),
        pytest.param(4, [1, 1], STAGGER, True, id="it goes round alone, whatever its timers"),
        pytest.param(4, [1, 1], BLOCK, False, id="a tie ends with a block"),
        pytest.param(4, [1, 1], MAJORITY, False, id="two of four are no majority"),
        pytest.param(5, [1, 1, 1], MAJORITY, False, id="nor are two of five"),
    ],
)
def test_refused_agent_has_a_livelock_unless_top_needs_majority(
    agents: int, holders: list[int], keys: dict[str, Any], goes_round: bool
) -> None:
    look = after_the_fork(agents, holders, keys)
    assert bool(look.cycles) == goes_round
    assert bool(look.astray[-1]) == goes_round, "more votes lead to one chain, unless somebody goes round"
