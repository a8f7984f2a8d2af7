"""Measure coverage: the share of the protocol's local states, inputs and branches that runs have reached.

See docs/explanation/coverage.md.

`reached` collects states, inputs and branches from traces, or while a simulated run is judged. `_share` compares them
with all states, inputs and branches within the bounds of a proof.
"""

from harness.proof.coverage._share import CoverageShare, ExistingStates, existing, in_words, to_json
from harness.proof.coverage.reached import CoverageWatcher, ReachedStates, reached_in

__all__ = [
    "CoverageShare",
    "CoverageWatcher",
    "ExistingStates",
    "ReachedStates",
    "existing",
    "in_words",
    "reached_in",
    "to_json",
]
