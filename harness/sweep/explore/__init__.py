"""Play seeds until a run violates a characteristic, and reduce that run to a small scenario.

`_exploring` plays seed after seed in the simulation. `_recording` replaces the random parts of a run, which are the
logged events and the lost messages, by a script in the scenario. `_smaller` removes parts of this scenario (delta
debugging) as long as the violation remains. The package `guided` explores for whole nights instead: it changes
scenarios at random, and keeps those that reach new states of the agents.
"""

from harness.sweep.explore._exploring import (
    SEEDS,
    Explored,
    explore,
    in_words,
    watching,
)

__all__ = ["SEEDS", "Explored", "explore", "in_words", "watching"]
