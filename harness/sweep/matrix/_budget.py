"""Choose the order of runs if the time is not sufficient for all of them.

A cell is a combination of values in the matrix. A further run is most useful in the cell whose results are least
certain. First, every cell gets two runs. After that, the next run belongs to the cell with the widest confidence
interval. The module considers two confidence intervals: that of the share of runs with one chain, and that of the
number of messages per block, divided by its mean. Cells with similar runs therefore get few runs, and cells with
different runs get most of the time.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence

from harness.sweep.matrix._cell import Run
from harness.sweep.matrix._estimate import BY_NAME, Estimate
from harness.sweep.matrix._matrix_file import MatrixPoint, MatrixTask

_FIRST_RUNS = 2


def informative(
    tasks: Sequence[MatrixTask],
    runs: Mapping[MatrixTask, Run],
    budget_s: float,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[MatrixTask]:
    """Yield tasks until the time budget is used up. `runs` contains the finished results. Whenever a run ends, the
    caller adds its result to `runs`.
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
    """Return how wide the widest confidence interval of a cell will probably be when all runs that have begun have
    ended.
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
