"""Play runs for `benchmarks.against`, with the revision of the project that is first on PYTHONPATH.

Each line on standard input names a kind of run and a seed, such as "explore/3". The program answers with a line that
contains the processor seconds per run. The program uses only functions that all revisions have. `bare_model` is in the
same directory, so that all revisions play the same model.
"""

import gc
import resource
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import bare_model

from harness.proof import Bounds, prove
from harness.run.simulate import simulate
from harness.scenario import Scenario
from harness.sweep.explore._exploring import simulated as explored
from harness.sweep.matrix._cell_play import simulated as cell

LOSS = (0.0, 0.10, 0.15, 0.25, 0.30, 0.50, 0.75, 1.00)
"""The loss rates of scenarios/thesis_matrix.yaml."""
SEEDS_OF_MATRIX = 10
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


FIVE, TWENTY, FIFTY = scenario(5), scenario(20), scenario(50)


def explore(seed: int) -> int:
    """Play seeds like `ucp-harness explore` on one core. Return the number of runs."""
    for number in range(SEEDS_OF_EXPLORE):
        explored(FIVE, seed * SEEDS_OF_EXPLORE + number)
    return SEEDS_OF_EXPLORE


def matrix(seed: int) -> int:
    """Play some seeds of all cells like `ucp-harness matrix` on one core. Return the number of runs."""
    cells = [scenario(5, loss, final_reconcile=False, settle_s=7200.0) for loss in LOSS]
    runs = list(product(cells, range(SEEDS_OF_MATRIX)))
    for of_loss, number in runs:
        cell(of_loss, seed * SEEDS_OF_MATRIX + number)
    return len(runs)


def proof(bounds: Bounds) -> int:
    """Prove the properties within these bounds on one core. Return the number of states."""
    with TemporaryDirectory() as directory:
        return prove(bounds, out=Path(directory) / "example.yaml").figures.states


def shell(seed: int) -> int:
    """Run `ucp-harness run` in a new process, which plays a mission and writes its run directory and report. Return
    1.
    """
    with TemporaryDirectory() as directory:
        command = [sys.executable, "-m", "harness.cli", "run", "loss_15", "--backend", "sim", "--seed", str(seed)]
        # `-m` finds modules in the working directory first, and another revision may be there
        subprocess.run([*command, "--out", f"{directory}/run"], stdout=subprocess.DEVNULL, cwd=directory, check=True)
    return 1


def once(play: Callable[[int], object]) -> Callable[[int], int]:
    def played(seed: int) -> int:
        play(seed)
        return 1

    return played


PLAYS = {
    "explore": explore,
    "matrix": matrix,
    "prove 4/2": lambda _: proof(Bounds(4, 2, "lossy")),
    "prove 3/3": lambda _: proof(Bounds(3, 3, "lossy")),
    "shell": shell,
}
for swarm in (FIVE, TWENTY, FIFTY):
    agents = swarm.agents
    PLAYS[f"bare {agents}"] = once(partial(bare_model.play, agents, 0.15))
    PLAYS[f"untraced {agents}"] = once(partial(simulate, swarm))
    PLAYS[f"traced {agents}"] = once(partial(simulate, swarm, tracing=True))


def processor_s() -> float:
    """Return the processor seconds of this process and of its child processes that have ended."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in used)


def main() -> None:
    for line in sys.stdin:
        what, _, seed = line.rpartition("/")
        gc.collect()  # what earlier runs left is not this one's
        began = processor_s()
        runs = PLAYS[what](int(seed))
        sys.stdout.write(f"{(processor_s() - began) / runs}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
