"""Compare the number of agent states that a search and random seeds reach: `python -m benchmarks.explore`.

Each round gives both methods the same processor time on one core. The order of the methods changes from round to round,
and each round has its own seeds. The same code plays and judges the runs of both methods. The mission `small` has three
agents that complete about three blocks. `prove` knows all agent states that this mission can reach if messages may be
lost. The mission `five` has five agents and about eight blocks.
"""

import argparse
import statistics
import sys
import time
from random import Random

from harness.proof import Bounds
from harness.proof.coverage import ExistingStates, ReachedStates, existing
from harness.scenario import Scenario
from harness.sweep.explore.guided._hunt import CandidateRun, Hunt
from harness.sweep.explore.guided._hunt_trial import initial_documents, play_trial

LOSS = {"network": {"loss": 0.15}}
SCENARIOS = {
    "small": {
        "name": "small",
        "agents": 3,
        "duration_s": 90,
        "settings": {"max_block_bytes": 267},
        "events": {"source": "random", "mean_s": 90},
        **LOSS,
    },
    "five": {"name": "five", "agents": 5, "duration_s": 200, **LOSS},
}
SEEDS_OF_ROUND = 1_000_000


def seeds_alone(scenario: Scenario, first_seed: int, budget_s: float) -> tuple[int, ReachedStates]:
    """Play runs with random seeds until the time is over. Return the number of runs, and the agent states that they
    reached.
    """
    reached, runs, ends_s = ReachedStates(), 0, time.process_time() + budget_s
    while time.process_time() < ends_s:
        reached.add(play_trial(scenario, first_seed + runs).reached)
        runs += 1
    return runs, reached


def hunted(scenario: Scenario, first_seed: int, budget_s: float) -> tuple[int, ReachedStates]:
    """Search until the time is over. Return the number of runs, and the agent states that they reached.

    The runs at the start of the search count too.
    """
    ends_s = time.process_time() + budget_s
    limits, begun = initial_documents(scenario, range(first_seed, first_seed + 4))
    hunt = Hunt(limits, Random(first_seed))
    playing = hunt.begin([CandidateRun(*each) for each in begun], 1)
    while time.process_time() < ends_s:
        if next(playing, None) is None:
            playing = hunt.round(1)
    return hunt.runs, hunt.reached


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="number of rounds")
    parser.add_argument("--seconds", type=float, default=60.0, help="processor time of each method in a round")
    parser.add_argument("--scenario", nargs="+", choices=SCENARIOS, default=list(SCENARIOS))
    arguments = parser.parse_args()
    for name in arguments.scenario:
        compare(Scenario.model_validate(SCENARIOS[name]), arguments.rounds, arguments.seconds)


def compare(scenario: Scenario, rounds: int, seconds: float) -> None:
    there = existing(Bounds(3, 3)) if scenario.name == "small" else None
    print_row(scenario.name, "seeds: runs", "local states", "hunt: runs", "local states", "ratio")
    ratios = []
    for number in range(rounds):
        first_seed = number * SEEDS_OF_ROUND
        ways = [seeds_alone, hunted] if number % 2 == 0 else [hunted, seeds_alone]
        came_to = {way: way(scenario, first_seed, seconds) for way in ways}
        (seeds_runs, by_seeds), (hunt_runs, by_hunt) = came_to[seeds_alone], came_to[hunted]
        ratios.append(len(by_hunt.states) / len(by_seeds.states))
        print_row(
            str(number + 1),
            str(seeds_runs),
            of(by_seeds, there),
            str(hunt_runs),
            of(by_hunt, there),
            f"{ratios[-1]:.1f}",
        )
    print_row("median", "", "", "", "", f"{statistics.median(ratios):.1f} ({min(ratios):.1f}..{max(ratios):.1f})")


def of(reached: ReachedStates, there: ExistingStates | None) -> str:
    """Return the number of reached agent states as text, with the number of states that exist within the bounds."""
    if there is None:
        return str(len(reached.states))
    return f"{len(reached.states)} ({len(reached.states & there.states)} of {len(there.states)})"


def print_row(*cells: str) -> None:
    sys.stdout.write("".join(f"{cell:>24}" for cell in cells) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
