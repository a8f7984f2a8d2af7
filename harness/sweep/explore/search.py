"""Seed after seed in the simulation, until a run is judged bad."""

from dataclasses import dataclass, field

from harness.run.finding import Judge
from harness.run.parallel import Failed, sweep
from harness.scenario import Scenario


@dataclass(frozen=True, slots=True)
class Violation:
    """The run of `seed` violates these characteristics, by number, and judgements beside them, by key."""

    seed: int
    keys: tuple[str, ...]


@dataclass
class Searched:
    """What became of seeds from the first on. `failed`: seed -> why there is no verdict on its run."""

    played: int = 0
    violation: Violation | None = None
    failed: dict[int, str] = field(default_factory=dict)
    interrupted: bool = False


def search(scenario: Scenario, seeds: range, jobs: int, judge: Judge, *, shown: bool = False) -> Searched:
    """Play `seeds` in order; the lowest that violates a characteristic is the one found, however many `jobs`.

    Ctrl-C ends it early. Raises HarnessError if the scenario cannot be played.
    """
    searched = Searched()
    try:
        with sweep(seeds, lambda seed: judge(scenario, seed).bad, jobs, what="seeds" if shown else None) as outcomes:
            for seed, outcome in outcomes:
                searched.played += 1
                if isinstance(outcome, Failed):
                    searched.failed[seed] = outcome.reason
                elif outcome:
                    searched.violation = Violation(seed, outcome)
                    break
    except KeyboardInterrupt:
        searched.interrupted = True
    return searched
