"""Compare the results of a matrix with those of an earlier night.

In virtual time, equal code gives equal runs, so two nights differ only where the code differs. The runs of a cell are
therefore compared in pairs with the same seed. A numeric result counts as changed if the confidence interval of the
mean difference of the pairs does not contain 0. If m results are compared, the confidence level of each interval is 1 -
0.05 / m (Bonferroni). Therefore, if nothing really changed, at least 95 % of the nights have no changed result.

Runs of processes always differ, so a comparison in pairs is impossible. A result of such runs counts as changed if the
95 % intervals of the two nights do not overlap.

The metric defines which direction is worse.
"""

from collections.abc import Iterator, Sequence

from pydantic import BaseModel, Field

from harness.play.backends import BACKENDS
from harness.sweep.matrix._cell import Cell, CellRecord, Run
from harness.sweep.matrix._estimate import BY_NAME, CONFIDENCE, Estimate, Metric, estimate_mean
from harness.sweep.matrix._matrix_file import MatrixPoint
from harness.sweep.matrix._run_steps import FirstChange


class Change(CellRecord):
    """A numeric result that has changed since an earlier night.

    `metric` is its name, `before` its old value, and `now` its new value. `difference` is the mean difference between
    runs with the same seed, with its corrected confidence interval. It is null if the runs are not compared in pairs.
    """

    metric: str
    before: Estimate
    now: Estimate
    worse: bool
    difference: Estimate | None = None


class ChangedRuns(CellRecord):
    """The simulated runs that differ from the same runs of the earlier night.

    `pairs` is the number of compared runs. `seeds` contains the seeds of the runs that differ. `first` contains the
    first changed handler run of at most `MAX_NAMED` of these runs.
    """

    pairs: int
    seeds: list[int]
    first: list[FirstChange] = Field(default_factory=list)


class CulpritCommit(BaseModel):
    """A commit that changed a numeric result of a run. `before` is the result before this commit, and `after` is the
    result after it.
    """

    hash: str
    date: str
    author: str
    subject: str
    before: float | None
    after: float | None


class Culprit(CellRecord):
    """The commits that made a numeric result worse, with the oldest commit first. `seed` is the seed of the run with
    which they were found. `problem` is the reason why the search did not find all of these commits, or null.
    """

    metric: str
    seed: int
    commits: list[CulpritCommit] = Field(default_factory=list)
    problem: str | None = None


class Comparison(BaseModel):
    """The comparison with an earlier night. `baseline` is the file of that night, and `cells` is the number of compared
    summaries.

    `started_at` is the start of that night. It is null if this version of the harness cannot read the file.
    """

    baseline: str
    started_at: str | None = None
    baseline_commit: str | None = None
    """The commit of the code in the earlier night. Null if it is unknown."""
    cells: int = 0
    changes: list[Change]
    changed_runs: list[ChangedRuns] = []
    culprits: list[Culprit] = []
    """The commits that made numeric results worse, if a search for them was requested."""
    not_compared: list[str] = []
    """A sentence for each difference between the two matrices that prevents the comparison of some cells."""

    @property
    def regressions(self) -> list[Change]:
        return [change for change in self.changes if change.worse]


def compare(before: Sequence[Cell], now: Sequence[Cell]) -> Iterator[Change]:
    """Yield the changes in the order of `now`. Combinations of values that occur in only one of the two matrices are
    skipped.
    """
    earlier = {cell.point: cell for cell in before}
    for cell in now:
        if cell.point not in earlier:
            continue
        for metric, was, is_now in _both(earlier[cell.point], cell):
            direction = _direction_of_change(was, is_now)
            if direction and metric.worse:
                worse = direction == metric.worse
                yield Change(**cell.point._asdict(), metric=metric.name, before=was, now=is_now, worse=worse)


def compare_pairs(
    before: Sequence[Cell], now: Sequence[Cell], runs_before: Sequence[Run], runs_now: Sequence[Run]
) -> tuple[list[Change], list[ChangedRuns]]:
    """Compare runs with the same seed in pairs, for all combinations of values that occur in both matrices."""
    earlier = {cell.point: cell for cell in before}
    runs = {run.task: run for run in runs_before}
    pairs: dict[MatrixPoint, list[tuple[Run, Run]]] = {}
    for run in runs_now:
        if run.task in runs and run.point in earlier:
            pairs.setdefault(run.point, []).append((runs[run.task], run))
    compared = [
        (cell.point, metric, was, is_now, _differences(metric, pairs[cell.point]))
        for cell in now
        if cell.point in pairs
        for metric, was, is_now in _both(earlier[cell.point], cell)
        if metric.worse
    ]
    confidence = 1 - (1 - CONFIDENCE) / max(1, len(compared))
    changes = []
    for point, metric, was, is_now, differences in compared:
        difference = estimate_mean(differences, confidence)
        if difference.low is None or difference.high is None or difference.low <= 0 <= difference.high:
            continue
        worse = (difference.low > 0) == (metric.worse == "higher")
        changes.append(
            Change(**point._asdict(), metric=metric.name, before=was, now=is_now, worse=worse, difference=difference)
        )
    changed = [
        ChangedRuns(
            **point._asdict(),
            pairs=len(its_pairs),
            seeds=[run.seed for was, run in its_pairs if _differ(was, run)],
        )
        for point, its_pairs in pairs.items()
    ]
    return changes, [each for each in changed if each.seeds]


def _differ(was: Run, run: Run) -> bool:
    """Return true if the two runs differ. If a run has no fingerprint, only numeric results and verdicts are
    compared.
    """
    steps_differ = bool(was.steps and run.steps) and was.steps != run.steps
    return steps_differ or (was.figures, was.verdicts) != (run.figures, run.verdicts)


def is_paired(point: MatrixPoint) -> bool:
    """Return true if equal code always gives equal runs for this combination of values, as in virtual time. Only such
    runs can be compared one by one.
    """
    return BACKENDS[point.backend].plays_in_memory


def _both(before: Cell, now: Cell) -> Iterator[tuple[Metric, Estimate, Estimate]]:
    for metric in BY_NAME.values():
        if metric.name in before.estimates and metric.name in now.estimates:
            yield metric, before.estimates[metric.name], now.estimates[metric.name]


def _differences(metric: Metric, pairs: Sequence[tuple[Run, Run]]) -> list[float]:
    values = [(metric.of(was.figures), metric.of(run.figures)) for was, run in pairs]
    return [after - before for before, after in values if before is not None and after is not None]


def _direction_of_change(before: Estimate, now: Estimate) -> str | None:
    """Return the direction of a change if the two confidence intervals do not overlap. Return None if they overlap."""
    if before.low is None or before.high is None or now.low is None or now.high is None:
        return None
    if now.high < before.low:
        return "lower"
    return "higher" if now.low > before.high else None
