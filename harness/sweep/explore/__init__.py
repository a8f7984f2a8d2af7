"""Explore seeds until a run violates a characteristic, and shrink that run to a small scenario.

`_exploring` plays seed after seed in the simulation. `_recording` turns chance into a document: the events that agents
logged, and the messages that were lost. `_shrink` removes parts of the document (delta debugging) as long as the
violation stays, in the order of `_smaller`. `guided` explores for whole nights instead: it changes scenarios, and keeps
those that reach something new.
"""

from harness.sweep.explore._explore_text import in_words, watching
from harness.sweep.explore._exploring import MAX_RUNS, SEEDS, Explored, Violation, Watcher, explore

__all__ = ["MAX_RUNS", "SEEDS", "Explored", "Violation", "Watcher", "explore", "in_words", "watching"]
