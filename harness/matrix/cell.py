"""Runs, and all runs at one loss rate summed up."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from pydantic import BaseModel

from harness.checker.characteristic import Verdict
from harness.checker.verdict import CHECKS
from harness.matrix.estimate import Estimate
from harness.matrix.metrics import METRICS, Figures


@dataclass(frozen=True, slots=True)
class Run:
    """What one run leaves here: figures, and a verdict for each characteristic; or why it has none (`failed`)."""

    loss: float
    seed: int
    figures: Figures = field(default_factory=dict)
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    failed: str | None = None


class Cell(BaseModel):
    """`runs` at one `loss`, of which `failed` have no figures; an estimate per metric; how often each verdict fell.

    `violated` has the seeds of the runs that violated a characteristic, to play them again.
    """

    loss: float
    runs: int
    failed: int
    estimates: dict[str, Estimate]
    verdicts: dict[str, dict[Verdict, int]]
    violated: dict[str, list[int]]


def sum_up(loss: float, runs: Sequence[Run]) -> Cell:
    judged = [run for run in runs if run.failed is None]
    violated = {number: [run.seed for run in judged if run.verdicts[number] == "violated"] for number in CHECKS}
    return Cell(
        loss=loss,
        runs=len(runs),
        failed=len(runs) - len(judged),
        estimates={metric.name: metric.estimate(run.figures for run in judged) for metric in METRICS},
        verdicts={number: dict(Counter(run.verdicts[number] for run in judged)) for number in CHECKS},
        violated={number: seeds for number, seeds in violated.items() if seeds},
    )
