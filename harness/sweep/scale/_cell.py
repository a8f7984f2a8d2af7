"""Runs, all runs of one size summed up, and how cost grows from size to size."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from pydantic import BaseModel

from harness.sweep.matrix._estimate import Estimate, Figures, Metric
from harness.sweep.scale._growth import Law, Variable, fit
from harness.sweep.scale._metrics import BY_NAME, MACHINE_METRICS, METRICS
from harness.sweep.scale.model import Scale, Size

Load = Literal["any", "below 1", "from 1"]


@dataclass(frozen=True, slots=True)
class Run:
    """What one run leaves here: figures and the characteristics that it violated; or why it has none (`failed`)."""

    size: Size
    seed: int
    figures: Figures = field(default_factory=dict)
    violated: tuple[str, ...] = ()
    failed: str | None = None


class Cell(BaseModel):
    """`runs` of one size, of which `failed` have no figures; an estimate per metric. `machine`: what they cost here."""

    loss: float
    minutes: float
    agents: int
    runs: int
    failed: int
    estimates: dict[str, Estimate]
    machine: dict[str, Estimate]

    @property
    def overloaded(self) -> bool:
        load = self.estimates["load"].mean
        return load is not None and load >= 1


class Growth(BaseModel):
    """How `metric` grows; each run is a point. Of the runs at this `loss`, with these `minutes` and `agents` if not
    null, in the cells with this `load`."""

    metric: str
    over: tuple[Variable, ...]
    loss: float
    minutes: float | None = None
    agents: int | None = None
    load: Load = "any"
    law: Law


def sum_up(size: Size, runs: Sequence[Run]) -> Cell:
    measured = [run.figures for run in runs if run.failed is None]

    def estimates(metrics: Iterable[Metric]) -> dict[str, Estimate]:
        return {metric.name: metric.estimate(measured) for metric in metrics}

    return Cell(
        **size._asdict(),
        runs=len(runs),
        failed=len(runs) - len(measured),
        estimates=estimates(METRICS),
        machine=estimates(MACHINE_METRICS),
    )


def growths(scale: Scale, cells: Sequence[Cell], runs: Sequence[Run], metrics: Iterable[str]) -> list[Growth]:
    """At each loss, over agents for each mission length, over blocks for each number of agents, and over both; where
    load falls on both sides of 1, over agents also for each side."""
    overloaded = {Size(cell.loss, cell.minutes, cell.agents) for cell in cells if cell.overloaded}
    grown: list[Growth] = []

    def add(metric: str, over: tuple[Variable, ...], load: Load, loss: float, **fixed: float) -> None:
        def belongs(run: Run) -> bool:
            its = {"loss": run.size.loss, "minutes": run.size.minutes, "agents": run.size.agents}
            return (
                run.failed is None
                and all(its[name] == value for name, value in {"loss": loss, **fixed}.items())
                and (load == "any" or (run.size in overloaded) == (load == "from 1"))
            )

        law = fit(over, _points(over, BY_NAME[metric].of, [run for run in runs if belongs(run)]))
        if law:
            grown.append(Growth(metric=metric, over=over, loss=loss, load=load, law=law, **fixed))  # type: ignore[arg-type]

    for loss in scale.loss:
        both = len({cell.overloaded for cell in cells if cell.loss == loss}) == 2
        parts: tuple[Load, ...] = ("any", "below 1", "from 1") if both else ("any",)
        for metric in metrics:
            for minutes in scale.minutes:
                for load in parts:
                    add(metric, ("agents",), load, loss, minutes=minutes)
            for agents in scale.agents:
                add(metric, ("blocks",), "any", loss, agents=agents)
            for load in parts:
                add(metric, ("agents", "blocks"), load, loss)
    return grown


def _points(
    over: tuple[Variable, ...], y_of: Callable[[Figures], float | None], runs: Iterable[Run]
) -> Iterable[tuple[list[float], float]]:
    """A run that cannot tell is a point with y 0: left out of the law, and counted."""
    for run in runs:
        yield [run.figures.get(name) or 0.0 for name in over], y_of(run.figures) or 0.0
