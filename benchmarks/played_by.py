"""Play runs for `benchmarks.against`, with the revision of the project that is first on PYTHONPATH.

A line on standard input names the kind of run and a seed, such as "explore/3". The answer is the processor time of each
run, in seconds. The program uses only functions that all revisions have.
"""

import gc
import sys
import time
from collections.abc import Callable
from itertools import product

from harness.run.simulate import simulate
from harness.scenario import Scenario
from harness.sweep.explore._exploring import simulated as explored
from harness.sweep.matrix._cell_play import simulated as cell

LOSS = (0.0, 0.10, 0.15, 0.25, 0.30, 0.50, 0.75, 1.00)
"""The loss rates of scenarios/thesis_matrix.yaml."""
SEEDS_OF_MATRIX = 200
SEEDS_OF_EXPLORE = 10


def scenario(agents: int, loss: float = 0.15, *, final_reconcile: bool = True, settle_s: float = 1200.0) -> Scenario:
    return Scenario.model_validate(
        {
            "name": "benchmark",
            "agents": agents,
            "network": {"loss": loss},
            "vehicles": {"kind": "none"},
            "settle": {"limit_s": settle_s},
            "final_reconcile": final_reconcile,
        }
    )


FIVE, FIFTY = scenario(5), scenario(50)


def explore(seed: int) -> int:
    """Play seeds like `ucp-harness explore` on one core; return the number of runs."""
    for number in range(SEEDS_OF_EXPLORE):
        explored(FIVE, seed * SEEDS_OF_EXPLORE + number)
    return SEEDS_OF_EXPLORE


def matrix(_: int) -> int:
    """Play all cells like `ucp-harness matrix` on one core; return the number of runs."""
    cells = [scenario(5, loss, final_reconcile=False, settle_s=7200.0) for loss in LOSS]
    runs = list(product(cells, range(SEEDS_OF_MATRIX)))
    for of_loss, number in runs:
        cell(of_loss, number)
    return len(runs)


def once(play: Callable[[int], object]) -> Callable[[int], int]:
    def played(seed: int) -> int:
        play(seed)
        return 1

    return played


PLAYS = {
    "untraced 5": once(lambda seed: simulate(FIVE, seed)),
    "traced 5": once(lambda seed: simulate(FIVE, seed, tracing=True)),
    "untraced 50": once(lambda seed: simulate(FIFTY, seed)),
    "traced 50": once(lambda seed: simulate(FIFTY, seed, tracing=True)),
    "explore": explore,
    "matrix": matrix,
}


def main() -> None:
    for line in sys.stdin:
        what, seed = line.split("/")
        gc.collect()  # what earlier runs left is not this one's
        began = time.process_time()
        runs = PLAYS[what](int(seed))
        sys.stdout.write(f"{(time.process_time() - began) / runs}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
