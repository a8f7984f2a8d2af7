"""Play seeds until a run violates a characteristic, and reduce that run to a small scenario.

`_exploring` plays seed after seed in the simulation. `_recording` replaces the random parts of a run, which are the
logged events and the lost messages, by a script in a document. `_smaller` removes parts of this document (delta
debugging) as long as the violation remains. The package `guided` explores for whole nights instead: it changes
scenarios, and keeps those that reach new states.
"""

from harness.sweep.explore._exploring import (
    SEEDS,
    Explored,
    explore,
    in_words,
    watching,
)

__all__ = ["SEEDS", "Explored", "explore", "in_words", "watching"]
