"""Runs, and all runs at one point of the matrix summed up."""

from collections import Counter
from collections.abc import Sequence

from pydantic import BaseModel, ConfigDict

from harness.backend_names import BackendName
from harness.checker.characteristic import Verdict
from harness.checker.verdict import CHECKS
from harness.matrix.estimate import Estimate
from harness.matrix.metrics import BEFORE_FINAL_RECONCILE, METRICS
from harness.matrix.model import Point, Task


class Placed(BaseModel):
    """What belongs to one point of the matrix."""

    model_config = ConfigDict(frozen=True)

    loss: float
    agents: int
    backend: BackendName

    @property
    def point(self) -> Point:
        return Point(self.loss, self.agents, self.backend)


class Run(Placed):
    """What one run leaves here: figures, and a verdict for each characteristic; or why it has none (`failed`)."""

    seed: int
    figures: dict[str, float | int | None] = {}
    verdicts: dict[str, Verdict] = {}
    failed: str | None = None

    @property
    def task(self) -> Task:
        return Task(self.point, self.seed)


class Cell(Placed):
    """`runs` at one point, of which `failed` have no figures; an estimate per metric; how often each verdict fell.

    `violated` has the seeds of the runs that violated a characteristic, to play them again.
    """

    runs: int
    failed: int
    estimates: dict[str, Estimate]
    verdicts: dict[str, dict[Verdict, int]]
    violated: dict[str, list[int]]


def sum_up(point: Point, runs: Sequence[Run]) -> Cell:
    judged = [run for run in runs if run.failed is None]
    estimates = {metric.name: metric.estimate(run.figures for run in judged) for metric in METRICS}
    before = {metric.name: metric.estimate(run.figures for run in judged) for metric in BEFORE_FINAL_RECONCILE}
    violated = {number: [run.seed for run in judged if run.verdicts[number] == "violated"] for number in CHECKS}
    return Cell(
        **point._asdict(),
        runs=len(runs),
        failed=len(runs) - len(judged),
        estimates=estimates | {name: estimate for name, estimate in before.items() if estimate.n},
        verdicts={number: dict(Counter(run.verdicts[number] for run in judged)) for number in CHECKS},
        violated={number: seeds for number, seeds in violated.items() if seeds},
    )
