"""Represent the result of one run, and the summary (cell) of all runs that differ only by their seed."""

from collections import Counter
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from harness.backend_names import BackendName
from harness.scenario.verdict_names import RUN_CHECKS, UNFINISHED, Verdict, kind_of
from harness.sweep.matrix import _estimate
from harness.sweep.matrix._estimate import BEFORE_FINAL_RECONCILE, METRICS, Estimate, estimate_share
from harness.sweep.matrix._matrix_file import MatrixPoint, MatrixTask


class CellRecord(BaseModel):
    """The base class of all records that belong to one combination of values in the matrix."""

    model_config = ConfigDict(frozen=True)

    loss: float
    agents: int
    backend: BackendName
    duration_s: float | None = None

    @property
    def point(self) -> MatrixPoint:
        return MatrixPoint(self.loss, self.agents, self.backend, self.duration_s)


class Run(CellRecord):
    """The result of one run: its numeric results, and its verdicts by the number or the key of the check. If a run has
    no verdict, `failed` contains the error, or `unsupported` names the feature that an agent lacks.
    """

    seed: int
    figures: dict[str, float | int | None] = {}
    verdicts: dict[str, Verdict] = {}
    deviates_in: str | None = None
    """The handler of the first step that deviates from the algorithms. None if no step deviates. If an edit broke code
    that the judge shares with the agents, the value contains the names of the edited files instead.
    """
    steps: str = ""
    """The fingerprint of the run's handler runs (see `_run_steps`). It is empty for real processes, and for runs
    without traces.
    """
    failed: str | None = None
    unsupported: str | None = None
    reached: Annotated[Any, Field(exclude=True)] = None
    """The states that this run reached (`harness.proof.coverage.ReachedStates`). None if the coverage was not measured.
    This field is not written to files.
    """

    @property
    def judged(self) -> bool:
        return self.failed is None and self.unsupported is None

    @property
    def task(self) -> MatrixTask:
        return MatrixTask(self.point, self.seed)


class Cell(CellRecord):
    """The summary of all runs with one combination of values. `failed` and `unsupported` are numbers of runs without
    numeric results.

    `estimates` contains an estimate for each metric. `verdicts` contains the number of runs with each verdict, for each
    check. `violated` contains the seeds of runs with a bad verdict, for each check. `unfinished` contains the seeds of
    runs in which the swarm only needed more time. `deviations` maps each value of `Run.deviates_in`, such as a handler
    that deviates from the algorithms, to the number of runs with this value.
    """

    runs: int
    failed: int
    estimates: dict[str, Estimate]
    verdicts: dict[str, dict[Verdict, int]]
    violated: dict[str, list[int]]
    unfinished: list[int] = []
    deviations: dict[str, int] = {}
    unsupported: int = 0

    @property
    def finished(self) -> Estimate:
        """The share of runs in which the swarm became idle. Runs without a verdict on liveness are not counted."""
        counts = self.verdicts.get("liveness", {})
        finished = counts.get("finished", 0)
        return estimate_share(finished, finished + counts.get("not finished", 0) + counts.get("never finishes", 0))


def is_wrong(verdict: Verdict) -> bool:
    """Return true for a bad verdict. Return false if the swarm only needs more time."""
    return kind_of(verdict) == "bad" and verdict != UNFINISHED


def sum_up(point: MatrixPoint, runs: Sequence[Run], *, grows: bool = False) -> Cell:
    """Return the summary of these runs. If `grows` is true, also estimate the numeric results that power laws need."""
    failed = sum(run.failed is not None for run in runs)
    unsupported = sum(run.unsupported is not None for run in runs)
    judged = [run for run in runs if run.judged]
    estimates = {metric.name: metric.estimate(run.figures for run in judged) for metric in METRICS}
    further = BEFORE_FINAL_RECONCILE + (_estimate.GROWTH_METRICS if grows else ())
    known = {metric.name: metric.estimate(run.figures for run in judged) for metric in further}
    verdicts = {key: {run.seed: run.verdicts[key] for run in judged if key in run.verdicts} for key in RUN_CHECKS}
    bad = {key: [seed for seed, verdict in by_seed.items() if is_wrong(verdict)] for key, by_seed in verdicts.items()}
    wrong = {seed for seeds in bad.values() for seed in seeds}
    unfinished = [seed for seed, verdict in verdicts["liveness"].items() if verdict == UNFINISHED and seed not in wrong]
    return Cell(
        **point._asdict(),
        runs=len(runs),
        failed=failed,
        unsupported=unsupported,
        estimates=estimates | {name: estimate for name, estimate in known.items() if estimate.n},
        verdicts={key: dict(Counter(by_seed.values())) for key, by_seed in verdicts.items() if by_seed},
        violated={key: seeds for key, seeds in bad.items() if seeds},
        unfinished=unfinished,
        deviations=dict(Counter(run.deviates_in for run in judged if run.deviates_in).most_common()),
    )
