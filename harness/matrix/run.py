"""The matrix's runs: each loss with each seed, spread over the cores, and summed up."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

from harness.checker import Result
from harness.matrix.cell import Run, sum_up
from harness.matrix.model import Matrix
from harness.matrix.record import FailedRun, MatrixRecord
from harness.run import versions
from harness.scenario import Scenario
from harness.sweep import Failed, sweep

Judge = Callable[[Scenario, int], Result]
"""Plays a scenario with a seed, and judges it."""


@dataclass(frozen=True)
class Finished:
    """A matrix that is over, also if it was interrupted: the runs that ended, by loss and then seed as in the file."""

    record: MatrixRecord
    runs: list[Run]


def run_matrix(matrix: Matrix, jobs: int, judge: Judge | None = None, *, shown: bool = False) -> Finished:
    """Play and sum up. Ctrl-C ends it early, with all that had ended. Raises HarnessError if it cannot be played.

    `judge` is the simulation unless given.
    """
    judge = judge or _simulated
    scenarios = {loss: matrix.scenario_at(loss) for loss in matrix.loss}
    started, started_at = time.monotonic(), datetime.now(UTC)

    def play(task: tuple[float, int]) -> Run:
        """In another process, of whose evidence only this comes back."""
        loss, seed = task
        result = judge(scenarios[loss], seed)
        verdicts = {number: one.verdict for number, one in result.characteristics.items()}
        return Run(loss, seed, result.figures, verdicts)

    runs: list[Run] = []
    interrupted = False
    tasks = [(loss, seed) for loss in matrix.loss for seed in matrix.seed_list]
    try:
        with sweep(tasks, play, jobs, what="runs" if shown else None) as outcomes:
            for (loss, seed), run in outcomes:
                runs.append(Run(loss, seed, failed=run.reason) if isinstance(run, Failed) else run)
    except KeyboardInterrupt:
        interrupted = True
    by_loss = {loss: [run for run in runs if run.loss == loss] for loss in matrix.loss}
    record = MatrixRecord(
        matrix=matrix,
        backend="sim",
        versions=versions(),
        started_at=started_at.isoformat(timespec="seconds").replace("+00:00", "Z"),
        wall_s=round(time.monotonic() - started, 1),
        outcome="interrupted" if interrupted else "completed",
        cells=[sum_up(loss, its_runs) for loss, its_runs in by_loss.items() if its_runs],
        failed=[FailedRun(loss=run.loss, seed=run.seed, reason=run.failed) for run in runs if run.failed is not None],
    )
    return Finished(record, runs)


def _simulated(scenario: Scenario, seed: int) -> Result:
    """Without traces, which cost more than the run: characteristic 1 is then not judged, 2 and 3 only at the end."""
    from harness.simulate import simulate

    return simulate(scenario, seed).result
