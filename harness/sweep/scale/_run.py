"""The sweep's runs: each size with each seed, the longest first so that no core is left with one at the end."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

from harness.checker import Result
from harness.play.mission import RunOutcome
from harness.run.parallel import Failed, sweep
from harness.run.run import versions
from harness.scenario import Scenario
from harness.sweep.scale._cell import Run, growths, sum_up
from harness.sweep.scale._metrics import FITTED, MACHINE_METRICS, measure
from harness.sweep.scale.model import Scale, Size
from harness.sweep.scale.record import Blemish, ScaleRecord

Judge = Callable[[Scenario, int], tuple[RunOutcome, Result]]
"""Plays a scenario with a seed, and judges it."""


@dataclass(frozen=True)
class Finished:
    """A sweep that is over, also if it was interrupted: the runs that ended, by size and then seed."""

    record: ScaleRecord
    runs: list[Run]


def run_scale(scale: Scale, jobs: int, judge: Judge | None = None, *, shown: bool = False) -> Finished:
    """Play and sum up. Ctrl-C ends it early, with what had ended. Raises HarnessError if it cannot be played.

    `judge` is the simulation unless given.
    """
    judge = judge or _simulated
    started, started_at = time.monotonic(), datetime.now(UTC)

    def play(task: tuple[Size, int]) -> Run:
        """In another process, of whose evidence only this comes back."""
        size, seed = task
        scenario = scale.scenario_at(size)
        wall, processor = time.monotonic(), time.process_time()
        played, result = judge(scenario, seed)
        cost = {"processor_s": time.process_time() - processor, "wall_s": time.monotonic() - wall}
        figures = {**measure(scenario, played, result), **{name: round(value, 3) for name, value in cost.items()}}
        return Run(size, seed, figures, result.bad)

    if scale.agent_command is not None:
        from harness.run.simulate import same_twice

        same_twice(scale.scenario_at(scale.sizes[0]), 1)
    runs: list[Run] = []
    interrupted = False
    tasks = sorted(
        ((size, seed) for size in scale.sizes for seed in range(1, scale.seeds + 1)),
        key=lambda task: -_effort(scale, task[0]),
    )
    try:
        with sweep(tasks, play, jobs, what="runs" if shown else None) as outcomes:
            for (size, seed), run in outcomes:
                runs.append(Run(size, seed, failed=run.reason) if isinstance(run, Failed) else run)
    except KeyboardInterrupt:
        interrupted = True
    runs.sort(key=lambda run: (run.size, run.seed))
    by_size = {size: [run for run in runs if run.size == size] for size in scale.sizes}
    cells = [sum_up(size, its_runs) for size, its_runs in by_size.items() if its_runs]
    record = ScaleRecord(
        scale=scale,
        backend="sim",
        versions=versions(),
        started_at=started_at.isoformat(timespec="seconds").replace("+00:00", "Z"),
        wall_s=round(time.monotonic() - started, 1),
        outcome="interrupted" if interrupted else "completed",
        cells=cells,
        growths=growths(scale, cells, runs, FITTED),
        machine_growths=growths(scale, cells, runs, [metric.name for metric in MACHINE_METRICS]),
        blemishes=[
            Blemish(**run.size._asdict(), seed=run.seed, failed=run.failed, violated=list(run.violated))
            for run in runs
            if run.failed is not None or run.violated
        ],
    )
    return Finished(record, runs)


def _effort(scale: Scale, size: Size) -> float:
    """What to expect of a run, in no unit: agents that all hear each other, and settle for long if they are many."""
    return size.agents**2 * (size.minutes + min(scale.settle_minutes, size.agents / 2))


def _simulated(scenario: Scenario, seed: int) -> tuple[RunOutcome, Result]:
    """Without traces, which cost more than the run: characteristic 1 is then not judged, 2 and 3 only at the end."""
    from harness.run.simulate import simulate

    simulated = simulate(scenario, seed)
    return simulated.played, simulated.result
