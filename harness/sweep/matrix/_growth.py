"""Fit power laws for the growth of numeric results with the number of agents and the number of blocks.

The length of the mission is not a variable, because it has an effect only through the number of blocks. The laws "over
blocks" therefore compare missions of several lengths.

A power law is y = a * x^b. It is fitted by least squares of the logarithms. Only values above 0 have a logarithm. Other
points are omitted and counted. The confidence interval of an exponent comes from Student's t distribution. It assumes
that the points scatter around the line independently and equally. If the growth is not a power law, this assumption is
false. In this case R^2 is low, or parts of the range have different exponents.
"""

import math
from collections.abc import Iterable, Sequence
from statistics import fmean, linear_regression
from typing import Literal

from pydantic import BaseModel, ConfigDict

from harness.backend_names import BackendName
from harness.sweep.matrix._cell import Cell, Run
from harness.sweep.matrix._estimate import CONFIDENCE, FITTED, GROWTH_BY_NAME, student_quantile
from harness.sweep.matrix._matrix_file import Matrix

Variable = Literal["agents", "blocks"]
MAX_INFLATION = 100.0
"""Maximum variance inflation factor, 1 / (1 - r^2). It is the factor by which a second variable increases the variance
of an exponent. Above this limit, the effects of the two variables cannot be separated.
"""


class Exponent(BaseModel):
    """The exponent of a variable in a power law. `low` and `high` are the limits of its 95 % confidence interval."""

    model_config = ConfigDict(frozen=True)

    value: float
    low: float
    high: float


class Law(BaseModel):
    """A power law: y = factor * product of the variables, each raised to its exponent.

    The law is fitted to `n` points. `left_out` is the number of omitted points, whose value is not above 0. `r_squared`
    is the share of the variance of log y that the law explains, or null if y does not vary.
    """

    model_config = ConfigDict(frozen=True)

    n: int
    left_out: int
    factor: float
    exponents: dict[Variable, Exponent]
    r_squared: float | None


def fit(names: Sequence[Variable], points: Iterable[tuple[Sequence[float], float]]) -> Law | None:
    """Fit a law of one or two variables to points (values of the variables, y).

    Return None if there are not more points than unknowns, if a variable is constant, or if the effects of two
    variables cannot be separated (`MAX_INFLATION`).
    """
    everything = list(points)
    usable = [([*map(math.log, xs)], math.log(y)) for xs, y in everything if y > 0 and min(xs) > 0]
    unknowns = len(names) + 1
    if len(usable) <= unknowns:
        return None
    columns = [list(column) for column in zip(*(xs for xs, _ in usable), strict=True)]
    ys = [y for _, y in usable]
    exponents: dict[Variable, tuple[float, float]] = {}
    for number, (name, column) in enumerate(zip(names, columns, strict=True)):
        others = columns[:number] + columns[number + 1 :]
        # The part of a variable that the other does not explain determines its exponent (Frisch, Waugh, Lovell).
        own = _unexplained(column, others[0]) if others else _centred(column)
        spread = sum(x * x for x in own)
        if spread * MAX_INFLATION <= sum(x * x for x in _centred(column)) or spread < 1e-12:
            return None
        exponents[name] = linear_regression(own, ys).slope, spread
    slopes = [slope for slope, _ in exponents.values()]
    intercept = fmean(ys) - sum(slope * fmean(column) for slope, column in zip(slopes, columns, strict=True))
    fitted = [intercept + sum(slope * x for slope, x in zip(slopes, xs, strict=True)) for xs, _ in usable]
    unexplained = sum((y - at) ** 2 for y, at in zip(ys, fitted, strict=True))
    varies = sum(y * y for y in _centred(ys))
    return Law(
        n=len(usable),
        left_out=len(everything) - len(usable),
        factor=_rounded(math.exp(intercept)),
        exponents={
            name: _exponent(slope, unexplained, spread, len(usable) - unknowns)
            for name, (slope, spread) in exponents.items()
        },
        r_squared=_rounded(1 - unexplained / varies) if varies > 1e-12 else None,
    )


def _exponent(slope: float, unexplained: float, spread: float, degrees: int) -> Exponent:
    margin = student_quantile((1 + CONFIDENCE) / 2, degrees) * math.sqrt(unexplained / degrees / spread)
    return Exponent(value=_rounded(slope), low=_rounded(slope - margin), high=_rounded(slope + margin))


def _centred(values: Sequence[float]) -> list[float]:
    mean = fmean(values)
    return [value - mean for value in values]


def _unexplained(values: Sequence[float], by: Sequence[float]) -> list[float]:
    """Return the residuals of `values`. A residual is the part of a value that a regression on another variable does
    not explain. The other variable may be constant.
    """
    if max(by) - min(by) < 1e-12:
        return _centred(values)
    slope, intercept = linear_regression(by, values)
    return [value - intercept - slope * x for value, x in zip(values, by, strict=True)]


def _rounded(number: float) -> float:
    """Round to six digits. Further digits have no meaning and differ between machines."""
    return float(f"{number:.6g}")


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
    use all sizes. If some cells have a load below 1 and others do not, laws over agents are also fitted separately to
    these two groups of cells.
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
        yield [values[name] for name in over], GROWTH_BY_NAME[metric].of(run.figures) or 0.0
