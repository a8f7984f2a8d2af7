"""The figures that the report lets its reader choose from."""

from collections.abc import Iterable
from dataclasses import dataclass

from harness.sweep.matrix.cell import Cell
from harness.sweep.matrix.estimate import Estimate, estimate_share
from harness.sweep.matrix.matrix_metrics import BEFORE_FINAL_RECONCILE, METRICS, Metric, figure
from harness.sweep.matrix.matrix_table import violated

MEANINGS = {
    "uniform": "Share of the runs that end with one uniform chain on all agents.",
    "mutual_share": "Share of a run\u2019s blocks that end in the chain that all agents have in common.",
    "distinct_chains": "How many different chains there are at the end.",
    "reconciles": "Reconciles of all agents.",
    "copies_mean": "In how many chains a block is at the end, mean of the blocks.",
    "copies_min": "In how many chains the block is at the end that fewest have.",
    "messages_per_block": "Messages that all agents sent for each block.",
    "uniform_before_final_reconcile": "Share of the runs that the mission left with one uniform chain.",
    "mutual_share_before_final_reconcile": "Share of a run\u2019s blocks that the mission left in all chains.",
    "finished": "Share of the runs whose agents became idle once no more events came.",
    "violated": "Share of the runs that violated a characteristic.",
}
_FINISHED = Metric("finished", "finished", figure("finished"), "share of runs")
_VIOLATED = Metric("violated", "violated", figure("violated"), "share of runs")


@dataclass(frozen=True, slots=True)
class Figure:
    metric: Metric

    @property
    def meaning(self) -> str:
        return MEANINGS[self.metric.name]

    def of(self, cell: Cell) -> Estimate:
        if self.metric is _VIOLATED:
            return estimate_share(violated(cell), cell.runs - cell.failed - cell.unsupported)
        if self.metric is _FINISHED:
            return cell.finished
        return cell.estimates.get(self.metric.name, Estimate(n=0))


def known(cells: Iterable[Cell]) -> list[Figure]:
    """Those that a run told, first what the mission left; the violated at least."""
    cells = list(cells)
    names = {name for cell in cells for name, estimate in cell.estimates.items() if estimate.n}
    metrics = [metric for metric in BEFORE_FINAL_RECONCILE + METRICS if metric.name in names]
    judged = [_FINISHED] if any(cell.finished.n for cell in cells) else []
    return [Figure(metric) for metric in (*metrics, *judged, _VIOLATED)]
