"""Fit power laws for the growth of numeric results with the number of agents and the number of blocks.

The length of the mission is not a variable, because it has an effect only through the number of blocks. The laws "over
blocks" therefore compare missions of several lengths.
"""

from collections.abc import Iterable, Sequence
from typing import Literal

from pydantic import BaseModel

from harness.backend_names import BackendName
from harness.sweep.matrix._cell import Cell, Run
from harness.sweep.matrix._growth_metrics import BY_NAME, FITTED
from harness.sweep.matrix._matrix_file import Matrix
from harness.sweep.matrix._power_law import Law, Variable, fit

Load = Literal["any", "below 1", "from 1"]


class Growth(BaseModel):
    """A power law for the growth of the numeric result `metric`.

    It is fitted to single runs. `backend`, `loss`, `duration_s`, `agents` and `load` are the values that these runs
    have in common. A value of null means that the runs have different values.
    """

    metric: str
    over: tuple[Variable, ...]
    backend: BackendName
    loss: float
    duration_s: float | None = None
    agents: int | None = None
    load: Load = "any"
    law: Law


def overloaded(cell: Cell) -> bool:
    """Return true if the agents of this cell complete blocks faster than the swarm can commit them."""
    load = cell.estimates["load"].mean if "load" in cell.estimates else None
    return load is not None and load >= 1


def growths(matrix: Matrix, cells: Sequence[Cell], runs: Sequence[Run]) -> list[Growth]:
    """Fit laws of growth for each backend and loss rate.

    Laws over agents are fitted for one mission length, and laws over blocks for one number of agents. Laws over both
    use all sizes. If the load is below 1 in only some cells, laws over agents are also fitted separately to the cells
    with a load below 1 and to the others.
    """
    load_of = {cell.point: "from 1" if overloaded(cell) else "below 1" for cell in cells}
    found: list[Growth] = []

    def add(over: tuple[Variable, ...], load: Load, **fixed: object) -> None:
        those = [
            run
            for run in runs
            if run.judged
            and load in ("any", load_of[run.point])
            and all(getattr(run, key) == value for key, value in fixed.items())
        ]
        for metric in FITTED:
            if law := fit(over, _points(over, metric, those)):
                found.append(Growth.model_validate({"metric": metric, "over": over, "load": load, "law": law, **fixed}))

    for backend in matrix.backend:
        for loss in matrix.loss:
            place = {"backend": backend, "loss": loss}
            sides = {load_of[cell.point] for cell in cells if (cell.backend, cell.loss) == (backend, loss)}
            loads: tuple[Load, ...] = ("any", "below 1", "from 1") if len(sides) == 2 else ("any",)
            for duration_s in matrix.duration_axis if matrix.grows_with_agents else ():
                for load in loads:
                    add(("agents",), load, **place, duration_s=duration_s)
            for agents in {point.agents: None for point in matrix.points} if matrix.grows_with_length else ():
                add(("blocks",), "any", **place, agents=agents)
            for load in loads if matrix.grows_with_agents and matrix.grows_with_length else ():
                add(("agents", "blocks"), load, **place)
    return found


def _points(over: tuple[Variable, ...], metric: str, runs: Iterable[Run]) -> Iterable[tuple[list[float], float]]:
    """Yield one point for each run. A power law is fitted to these points. An unknown value becomes 0, so that `fit`
    omits the run and counts it.
    """
    for run in runs:
        values = {"agents": run.agents, "blocks": run.figures.get("blocks") or 0.0}
        yield [values[name] for name in over], BY_NAME[metric].of(run.figures) or 0.0
