"""Test `--budget`: uncertain cells come first, no run begins after the time is over, and the output lists the omitted
runs.
"""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from harness.sweep.matrix import matrix_outputs, run_matrix
from harness.sweep.matrix._cell import Run
from harness.sweep.matrix._matrix_file import MatrixTask
from harness.sweep.matrix.matrix_run import informative, on_cores
from harness.sweep.matrix.matrix_summary import verdict
from tests.harness.command import harness
from tests.harness.sweep.matrix.stub import matrix

LOSS = (0.0, 0.1, 0.2)


def ticking(seconds: list[float]) -> Callable[[], float]:
    """Return a clock whose time increases by one second at each call."""

    def clock() -> float:
        seconds[0] += 1
        return seconds[0]

    return clock


def order(most: float, chains: Callable[[float, int], int], late: int = 0) -> list[MatrixTask]:
    """Return the tasks in the order in which they begin. The result of a task is known after `late` more tasks have
    begun.
    """
    asked, runs, begun = matrix(loss=LOSS, seeds=20), dict[MatrixTask, Run](), list[MatrixTask]()
    for task in informative(asked.tasks, runs, most, ticking([0.0])):
        begun.append(task)
        if len(begun) > late:
            known = begun[len(begun) - 1 - late]
            figures = {"distinct_chains": chains(known.point.loss, known.seed), "messages_per_block": 20}
            runs[known] = Run(**known.point._asdict(), seed=known.seed, figures=figures)
    return begun


@pytest.mark.parametrize("late", [0, 3])
def test_uncertain_cell_gets_the_time_after_two_runs_of_each(late: int) -> None:
    begun = order(24, lambda loss, seed: 1 + seed % 2 if loss == 0.1 else 1, late)
    assert Counter(task.point.loss for task in begun[:6]) == dict.fromkeys(LOSS, 2)
    counts = Counter(task.point.loss for task in begun)
    assert counts[0.1] > max(counts[0.0], counts[0.2]) >= 2
    assert [task.seed for task in begun if task.point.loss == 0.1] == list(range(1, counts[0.1] + 1))


def test_all_runs_are_played_if_the_time_suffices() -> None:
    begun = order(1000, lambda loss, seed: 1)
    assert sorted(begun) == sorted(matrix(loss=LOSS, seeds=20).tasks)


def test_run_that_did_not_begin_is_no_interruption(tmp_path: Path) -> None:
    asked = matrix(seeds=3)
    finished = run_matrix(asked, tmp_path, on_cores(asked, 1), budget_s=1e-9)
    assert (finished.record.outcome, finished.record.exit_status, finished.runs) == ("completed", 0, [])
    assert verdict(finished.record).startswith("0 runs of 6 in the given time")
    matrix_outputs.write(finished, tmp_path)
    assert (tmp_path / "junit.xml").read_text().count('message="the time was used up: 0 of 3 runs had ended"') == 2


def test_wrong_budget_is_refused() -> None:
    refused = harness("matrix", "growth_matrix", "--budget", "soon")
    assert refused.returncode == 2
    assert "is not a time" in refused.stderr
