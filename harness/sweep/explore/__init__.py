"""Play seeds until a run violates a characteristic, and reduce that run to a small scenario.

`_exploring` plays seed after seed in the simulation. `_recording` turns the random parts of a run into a document: the
logged events and the lost messages. `_shrink` removes parts of the document (delta debugging) as long as the violation
remains, in the order of `_smaller`. `guided` explores for whole nights instead. It changes scenarios, and keeps those
that reach new states.
"""

from harness.sweep.explore._explore_text import in_words, watching
from harness.sweep.explore._exploring import MAX_RUNS, SEEDS, Explored, SearchProgress, ViolatingRun, explore

__all__ = ["MAX_RUNS", "SEEDS", "Explored", "SearchProgress", "ViolatingRun", "explore", "in_words", "watching"]
