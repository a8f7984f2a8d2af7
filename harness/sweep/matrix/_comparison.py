"""Compare the cells of a matrix with those of an earlier night: which figures changed by more than chance explains?

A figure changed if its two 95 % intervals do not overlap. The metric states which direction is worse.
"""

from collections.abc import Iterator, Sequence

from pydantic import BaseModel

from harness.sweep.matrix._cell import AtPoint, Cell
from harness.sweep.matrix._estimate import BY_NAME, Estimate


class Change(AtPoint):
    """A changed figure: `metric` was `before` and is `now`. The two 95 % intervals do not overlap."""

    metric: str
    before: Estimate
    now: Estimate
    worse: bool


class Comparison(BaseModel):
    """The comparison with an earlier matrix, which started at `started_at`. `baseline` is its matrix.json."""

    baseline: str
    started_at: str
    changes: list[Change]

    @property
    def regressions(self) -> list[Change]:
        return [change for change in self.changes if change.worse]


def compare(before: Sequence[Cell], now: Sequence[Cell]) -> Iterator[Change]:
    """Yield the changes in the order of `now`. Cells that exist in only one of the matrices are left out."""
    earlier = {cell.point: cell for cell in before}
    for cell in now:
        if cell.point not in earlier:
            continue
        figures_before = earlier[cell.point].estimates
        for metric in BY_NAME.values():
            if metric.name not in figures_before or metric.name not in cell.estimates:
                continue
            was, is_now = figures_before[metric.name], cell.estimates[metric.name]
            direction = _moved(was, is_now)
            if direction and metric.worse:
                worse = direction == metric.worse
                yield Change(**cell.point._asdict(), metric=metric.name, before=was, now=is_now, worse=worse)


def _moved(before: Estimate, now: Estimate) -> str | None:
    """Return the direction of the change if the intervals do not overlap. Without both intervals, return None."""
    if before.low is None or before.high is None or now.low is None or now.high is None:
        return None
    if now.high < before.low:
        return "lower"
    return "higher" if now.low > before.high else None
