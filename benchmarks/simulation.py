"""Compare the speed of the simulation with that of a bare model: `python -m benchmarks.simulation [--rounds 5]`.

`--agents 200 --loss 0.15 --settle 1200 --rounds 1` measures the largest swarm. `--matrix` also measures a matrix of
five agents with 8 loss rates and 200 seeds.

The bare model (`benchmarks.bare_model`) is the protocol alone in one file. The simulation and the model run
alternately, so that a slow phase of the machine affects both. Times are processor times. The checker judges each
simulation at its end. Runs with `--traced` have traces and all checks.
"""

import argparse
import gc
import resource
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial

from benchmarks.bare_model import play
from harness.run.simulate import simulate
from harness.scenario import Scenario

MATRIX_LOSS = [0.0, 0.05, 0.10, 0.15, 0.20, 0.25, 0.30, 0.35]
MATRIX_SEEDS = 200


def scenario(agents: int, loss: float, settle_s: float) -> Scenario:
    return Scenario.model_validate(
        {"name": "benchmark", "agents": agents, "network": {"loss": loss}, "settle": {"limit_s": settle_s}}
    )


def seconds(what: Callable[[], object]) -> float:
    gc.collect()  # the garbage of earlier runs does not count
    began = time.process_time()
    what()
    return time.process_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="number of rounds")
    parser.add_argument("--agents", type=int, nargs="+", default=[5, 20, 50], help="numbers of agents")
    parser.add_argument("--loss", type=float, nargs="+", default=[0.15, 0.30], help="loss rates")
    parser.add_argument("--settle", type=float, default=7200.0, help="maximum of mission seconds after minute 20")
    parser.add_argument("--traced", action="store_true", help="also with traces")
    parser.add_argument("--matrix", action="store_true", help=f"also {len(MATRIX_LOSS)} x {MATRIX_SEEDS} runs of 5")
    arguments = parser.parse_args()
    print_row("agents", "loss", "broadcasts", "bare model", "simulation", "ratio", "peak so far", "traced", "ratio")
    for agents in arguments.agents:
        for loss in arguments.loss:
            row(scenario(agents, loss, arguments.settle), agents, loss, arguments.rounds, arguments.traced)
    if arguments.matrix:
        print_row("matrix", f"{len(MATRIX_LOSS)} x {MATRIX_SEEDS}", ms(seconds(matrix)))


def matrix() -> None:
    """Play all runs like `ucp-harness matrix` on one processor core, without writing files."""
    for loss in MATRIX_LOSS:
        cell = scenario(5, loss, 1800.0)
        for seed in range(MATRIX_SEEDS):
            simulate(cell, seed)


def row(what: Scenario, agents: int, loss: float, rounds: int, traced: bool) -> None:
    broadcasts = []
    times: dict[str, list[float]] = {"bare": [], "plain": [], "traced": []}
    for seed in range(rounds):
        messages = simulate(what, seed).result.figures["messages"]
        assert isinstance(messages, int)
        broadcasts.append(messages)
        times["plain"].append(seconds(partial(simulate, what, seed)))
        times["bare"].append(seconds(partial(play, agents, loss, seed, what.settle.limit_s, final_reconcile=False)))
        if traced:
            times["traced"].append(seconds(partial(simulate, what, seed, tracing=True)))
    bare, plain = statistics.median(times["bare"]), statistics.median(times["plain"])
    cells = [
        str(agents),
        f"{loss:.2f}",
        str(round(statistics.median(broadcasts))),
        ms(bare),
        ms(plain),
        f"{plain / bare:.2f}",
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB",
    ]
    if traced:
        with_traces = statistics.median(times["traced"])
        cells += [ms(with_traces), f"{with_traces / plain:.2f} x"]
    print_row(*cells)


def ms(duration_s: float) -> str:
    return f"{duration_s * 1000:.1f} ms"


def print_row(*cells: str) -> None:
    sys.stdout.write("".join(f"{cell:>14}" for cell in cells) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
