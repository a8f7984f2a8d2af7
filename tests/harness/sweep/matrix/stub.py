"""Return results of runs for tests of a matrix, without a simulation. The numeric results of a run are computed from
its loss rate and its seed.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from harness.checker import Result
from harness.checker.judgement import Judgement, Verdict
from harness.play.mission import RunOutcome
from harness.scenario import Scenario
from harness.sweep.matrix import Finished, Matrix, run_matrix
from harness.sweep.matrix._cell_play import JudgedRun
from harness.sweep.matrix.matrix_run import on_cores

Judge = Callable[[Scenario, int], Result]

CHARACTERISTICS = ("1", "2", "3", "4", "5", "6")


def matrix(
    *, name: str = "test", loss: tuple[float, ...] = (0.0, 0.5), seeds: int | list[int] = 4, **keys: Any
) -> Matrix:
    return Matrix.model_validate(
        {"name": name, "scenario": {"agents": 5} if "agents" not in keys else {}, "loss": list(loss), "seeds": seeds}
        | keys
    )


def played(asked: Matrix, jobs: int, judge: Judge, directory: Path | None = None) -> Finished:
    """Play the matrix into `directory`. By default, use a temporary directory."""

    def plays(scenario: Scenario, seed: int) -> JudgedRun:
        return JudgedRun(RunOutcome(mission_s=scenario.duration_s + 100, settled=True), judge(scenario, seed))

    with tempfile.TemporaryDirectory() as folder:
        return run_matrix(asked, directory or Path(folder), on_cores(asked, jobs), plays)


def judge(scenario: Scenario, seed: int) -> Result:
    """Return good verdicts without loss. With loss, return a violation of characteristic 3 for seed 2."""
    loss = scenario.network.loss
    assert isinstance(loss, float)
    verdict: Verdict = "violated" if loss and seed == 2 else "holds"
    return Result(
        {number: Judgement(number, verdict if number == "3" else "holds", "") for number in CHARACTERISTICS},
        {
            "agents": 5,
            "blocks": 40,
            "mutual_chain": round(40 * (1 - loss)) - seed % 2,
            "distinct_chains": 1 if not loss else 2 + seed % 2,
            "copies_min": 5 if not loss else 1,
            "copies_mean": 5 - 4 * loss,
            "reconciles": round(20 * loss) + seed,
            "messages": 800,
            "bytes": None,
            "messages_per_block": 20 + 10 * loss,
        },
    )
