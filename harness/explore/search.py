"""Seed after seed in the simulation, until a run is judged bad."""

from collections.abc import Callable
from dataclasses import dataclass, field

from harness.checker import Result
from harness.checker.judgement import Finding, Judgement
from harness.gc_pause import gc_paused
from harness.play.simulation.foreign.failure import AgentFailedError
from harness.run.simulate import simulate
from harness.run.sweep import Failed, sweep
from harness.scenario import Scenario

Judge = Callable[[Scenario, int], Result]
"""Plays a scenario with a seed, and judges it."""


ENDED = "ended"
"""Key of what an agent is judged by that did not get to the end of its mission."""


@gc_paused()
def simulated(scenario: Scenario, seed: int) -> Result:
    """With traces, so that all six characteristics are judged; of a run that an agent ended, only that it did."""
    try:
        return simulate(scenario, seed, tracing=True).result
    except AgentFailedError as error:
        return ended_by(error)


def ended_by(error: AgentFailedError) -> Result:
    """An agent crashed or hung: there is no more to judge, and no less to find and to shrink."""
    finding = Finding(error.agent_id, f"{error.outcome}: it {error.detail}")
    judgement = Judgement("every agent to the end", "violated", f"agent {error.agent_id} {error.outcome}", [finding])
    return Result({}, {}, {ENDED: judgement})


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
