"""Carry out all runs of a matrix on this machine or on a cluster, and summarise their results.

If the time is not sufficient for all runs, the module chooses their order. A cell is a combination of values in the
matrix. A further run is most useful in the cell whose results are least certain. First, every cell gets two runs. After
that, the next run belongs to the cell with the widest confidence interval. The module considers the confidence
intervals of two results: the share of runs with one chain, and the number of messages per block. The interval of the
number of messages is divided by the mean number. Cells with similar runs therefore get few runs, and cells with
different runs get most of the time.
"""

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from harness.archive.directory import default_path
from harness.errors import InterruptedRunError
from harness.run.parallel import FailedTask, cores, sweep
from harness.run.provenance import versions
from harness.scenario import Scenario
from harness.sweep.matrix._away import AwayPlayer, AwayRun, cluster
from harness.sweep.matrix._cell import Run, sum_up
from harness.sweep.matrix._cell_play import Judge, RunPlayer, simulated
from harness.sweep.matrix._comparison import Comparison, compare, compare_pairs, is_paired
from harness.sweep.matrix._culprits import find_culprits
from harness.sweep.matrix._estimate import BY_NAME, Estimate
from harness.sweep.matrix._growth import growths
from harness.sweep.matrix._matrix_file import Matrix, MatrixPoint, MatrixTask
from harness.sweep.matrix._results_file import MatrixResults, opened
from harness.sweep.matrix._run_steps import FirstChange, first_changed, name_change
from harness.sweep.matrix.matrix_record import CoverageTally, MatrixRecord, RunWithoutResult
from harness.sweep.matrix.nights import BaselineNight

_FIRST_RUNS = 2


def informative(
    tasks: Sequence[MatrixTask],
    runs: Mapping[MatrixTask, Run],
    budget_s: float,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[MatrixTask]:
    """Yield the tasks in the order in which their runs are most useful, until the time budget is used up. `runs`
    contains the finished results. Whenever a run ends, the caller adds its result to `runs`.
    """
    until = clock() + budget_s
    begun = Counter(task.point for task in runs)
    left: dict[MatrixPoint, list[MatrixTask]] = {}
    for task in tasks:
        left.setdefault(task.point, []).append(task)
    while left and clock() < until:
        point = max(left, key=lambda point: _information(point, runs, begun[point]))
        begun[point] += 1
        yield left[point].pop(0)
        if not left[point]:
            del left[point]


def _information(point: MatrixPoint, runs: Mapping[MatrixTask, Run], begun: int) -> float:
    """Return the expected benefit of a further run of this cell. The benefit is the probable width of the cell's widest
    confidence interval after the end of all runs that are in progress.
    """
    if begun < _FIRST_RUNS:
        return float(2 * _FIRST_RUNS - begun)
    ended = [run.figures for task, run in runs.items() if task.point == point and run.judged]
    if len(ended) < _FIRST_RUNS:
        return 1.0 / begun
    share, messages = (BY_NAME[name].estimate(ended) for name in ("uniform", "messages_per_block"))
    width = max(_width(share), _width(messages) / abs(messages.mean or 1.0))
    return float(width * (len(ended) / begun) ** 0.5)


def _width(estimate: Estimate) -> float:
    return 0.0 if estimate.low is None or estimate.high is None else estimate.high - estimate.low


Outcomes = Iterator[tuple[MatrixTask, Run | FailedTask]]
Spread = Callable[[Iterable[MatrixTask], RunPlayer], AbstractContextManager[Outcomes]]
"""A function that distributes tasks over processes or machines, and yields each result as soon as it is complete."""


MAX_NAMED = 50
"""Maximum number of changed runs in a cell for which the first changed handler run is determined."""


@dataclass(frozen=True)
class Finished:
    """The results of a matrix whose runs have all ended, or that was interrupted. The object contains the summarised
    results and the single runs. The runs are in the order of their values and seeds.
    """

    record: MatrixRecord
    runs: list[Run]


def on_cores(matrix: Matrix, jobs: int, *, shown: bool = False) -> Spread:
    """Return a function that distributes the runs over `jobs` processes of this machine."""
    if matrix.needs_processes:
        jobs = min(jobs, cores())
    return partial(sweep, jobs=jobs, what="runs" if shown else None, in_order=False)


def on_cluster(address: str, *, shown: bool = False) -> Spread:
    """Return a function that distributes the runs over the workers of the Dask scheduler at `address`."""

    @contextmanager
    def spread(tasks: Iterable[MatrixTask], play: RunPlayer) -> Iterator[Outcomes]:
        with cluster(tasks, AwayPlayer(play), address, what="runs" if shown else None) as outcomes:
            yield ((task, run.unpack(play.directory) if isinstance(run, AwayRun) else run) for task, run in outcomes)

    return spread


def run_matrix(
    matrix: Matrix,
    out: Path | None = None,
    spread: Spread | None = None,
    judge: Judge | None = None,
    *,
    covers: bool = False,
    budget_s: float | None = None,
    elsewhere: bool = False,
) -> Finished:
    """Play every run of a matrix, and summarise the runs for each combination of values.

    - `out`: the directory of `results.jsonl`. It is new or empty, or contains earlier results of the same matrix. Runs
      with a result are not played again. By default, a new directory under `runs/`.
    - `spread`: the function that distributes the runs. By default, it uses all processor cores of this machine.
    - `judge`: the function that plays and checks one run in virtual time. By default, the simulation is used.
    - `budget_s`: the number of seconds after which no further run begins. The cells with the most uncertain results
      come first. By default, all runs are played.
    - `elsewhere`: if true, other machines play the runs. Each of these machines checks whether it can play its runs.
    - `covers`: if true, also measure the share of the protocol's states that the runs reach. This takes longer.

    Ctrl-C ends the matrix early, with the results of the runs that have ended. Raises HarnessError if the matrix cannot
    be played.
    """
    with opened((out or default_path(matrix.name)).absolute(), matrix) as results:
        judge = judge or partial(simulated, tracing=matrix.traces)
        play = RunPlayer(matrix, results.directory / "runs", judge, covers)
        return _run_missing(matrix, results, spread or on_cores(matrix, cores()), play, budget_s, elsewhere)


def _run_missing(
    matrix: Matrix,
    results: MatrixResults,
    spread: Spread,
    play: RunPlayer,
    budget_s: float | None,
    elsewhere: bool,
) -> Finished:
    started = time.monotonic()
    tasks = [task for task in matrix.tasks if task not in results.runs]
    if matrix.grows:  # the longest runs first, so that no core waits for a long run at the end
        tasks.sort(key=lambda task: _effort(matrix.scenario_at(task.point)), reverse=True)
    if not elsewhere:
        play.refuse(dict.fromkeys(task.point for task in tasks))
    interrupted, tally = False, CoverageTally() if play.covers else None
    try:
        chosen = tasks if budget_s is None else informative(tasks, results.runs, budget_s)
        with spread(chosen, play) as outcomes:
            for task, run in outcomes:
                results.add(_failed(task, run.reason) if isinstance(run, FailedTask) else run)
                if tally is not None and isinstance(run, Run) and run.reached is not None:
                    tally.add(task.point, run.reached)
    except (KeyboardInterrupt, InterruptedRunError):
        interrupted = True
    runs = [results.runs[task] for task in matrix.tasks if task in results.runs]
    by_point: dict[MatrixPoint, list[Run]] = defaultdict(list)
    for run in runs:
        by_point[run.point].append(run)
    cells = [sum_up(point, its_runs, grows=matrix.grows) for point, its_runs in by_point.items()]
    record = MatrixRecord(
        matrix=matrix,
        backend=matrix.backend[0] if len(matrix.backend) == 1 else "several",
        versions=versions(),
        started_at=results.started_at,
        wall_s=round(time.monotonic() - started, 1),
        outcome="interrupted" if interrupted else "completed",
        budget_s=budget_s,
        cells=cells,
        results=[run.model_copy(update={"reached": None}) for run in runs if run.judged and is_paired(run.point)],
        failed=[_without_result(run, run.failed) for run in runs if run.failed is not None],
        unsupported=[_without_result(run, run.unsupported) for run in runs if run.unsupported is not None],
        tried=None if tally is None else tally.tried(matrix, len(runs)),
        growths=growths(matrix, cells, runs) if matrix.grows else [],
    )
    return Finished(record, runs)


def compare_with(finished: Finished, baseline: BaselineNight) -> Finished:
    """Return the results of a matrix with the changes since an earlier night."""
    if baseline.record is None:
        comparison = Comparison(baseline=str(baseline.path), changes=[], not_compared=baseline.not_compared)
        return Finished(finished.record.model_copy(update={"against": comparison}), finished.runs)
    comparable = [cell for cell in baseline.record.cells if cell.point in baseline.points]
    with_runs = {run.point for run in baseline.record.results}
    paired = {cell.point for cell in comparable if is_paired(cell.point) and cell.point in with_runs}
    changes = list(compare([cell for cell in comparable if cell.point not in paired], finished.record.cells))
    changes_in_pairs, changed_runs = compare_pairs(
        [cell for cell in comparable if cell.point in paired],
        finished.record.cells,
        baseline.record.results,
        finished.record.results,
    )
    comparison = Comparison(
        baseline=str(baseline.path),
        started_at=baseline.record.started_at,
        baseline_commit=baseline.record.versions.get("commit"),
        cells=len(baseline.points),
        changes=[*changes_in_pairs, *changes],
        changed_runs=changed_runs,
        not_compared=baseline.not_compared,
    )
    return Finished(finished.record.model_copy(update={"against": comparison}), finished.runs)


def name_changes(finished: Finished, baseline: BaselineNight, jobs: int) -> Finished:
    """Find the first changed handler run for each changed run, but for at most MAX_NAMED runs in a cell. Return the
    results of the matrix with these names.

    The runs are played again. Ctrl-C ends the search, and the remaining changes have no name.
    """
    comparison, earlier = finished.record.against, baseline.record
    if comparison is None or earlier is None:
        return finished
    before, now = ({run.task: run.steps for run in record.results} for record in (earlier, finished.record))
    tasks = [MatrixTask(each.point, seed) for each in comparison.changed_runs for seed in each.seeds[:MAX_NAMED]]
    tasks = [task for task in tasks if before.get(task) and now.get(task)]

    def name(task: MatrixTask) -> FirstChange | None:
        position = first_changed(before[task], now[task])
        return (
            None
            if position is None
            else name_change(finished.record.matrix.scenario_at(task.point), task.seed, position)
        )

    named: dict[MatrixPoint, list[FirstChange]] = defaultdict(list)
    with suppress(KeyboardInterrupt), sweep(tasks, name, jobs, what="changed runs") as outcomes:
        for task, change in outcomes:
            if isinstance(change, FirstChange):
                named[task.point].append(change)
    changed = [each.model_copy(update={"first": named[each.point]}) for each in comparison.changed_runs]
    against = comparison.model_copy(update={"changed_runs": changed})
    return Finished(finished.record.model_copy(update={"against": against}), finished.runs)


def name_culprits(
    finished: Finished, baseline: BaselineNight, budget_s: float, report_progress: Callable[[str], None]
) -> Finished:
    """Return the results of a matrix with the commits that made numeric results worse."""
    if finished.record.against is None or baseline.record is None:
        return finished
    culprits = find_culprits(finished.record, baseline.record, budget_s, report_progress)
    against = finished.record.against.model_copy(update={"culprits": culprits})
    return Finished(finished.record.model_copy(update={"against": against}), finished.runs)


def _effort(scenario: Scenario) -> float:
    """Return an estimate of the time that a run takes, in arbitrary units. The time grows with the number of messages
    and with the number of agents.
    """
    agents = len(scenario.roster)
    return agents**2 * (scenario.duration_s + min(scenario.settle.limit_s, 30 * agents))


def _without_result(run: Run, reason: str) -> RunWithoutResult:
    return RunWithoutResult(**run.point._asdict(), seed=run.seed, reason=reason)


def _failed(task: MatrixTask, reason: str) -> Run:
    return Run(**task.point._asdict(), seed=task.seed, failed=reason)
