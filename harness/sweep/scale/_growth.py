"""How one thing grows with another: power laws y = a * x^b, by least squares in logarithms.

A logarithm exists of values above 0 only; the others are left out and counted. The interval of an exponent is
Student's, which takes the points' distances from the line for independent and alike. Where the law bends, they are
not: a low R^2, or different exponents in parts of the range, say so.
"""

import math
from collections.abc import Iterable, Sequence
from statistics import fmean, linear_regression
from typing import Literal

from pydantic import BaseModel, ConfigDict

from harness.sweep.matrix._estimate import CONFIDENCE, student_quantile

Variable = Literal["agents", "blocks"]
MAX_INFLATION = 100.0
"""How much a second variable may inflate the variance of an exponent (1 / (1 - r^2)), before the two are one."""


class Exponent(BaseModel):
    """`value` with its 95 % interval."""

    model_config = ConfigDict(frozen=True)

    value: float
    low: float
    high: float


class Law(BaseModel):
    """y = factor * product of variables, each to its exponent; of `n` points, with `left_out` others that were not > 0.

    `r_squared` is the share of the variance of log y that it explains; null where y does not vary.
    """

    model_config = ConfigDict(frozen=True)

    n: int
    left_out: int
    factor: float
    exponents: dict[Variable, Exponent]
    r_squared: float | None


def fit(names: Sequence[Variable], points: Iterable[tuple[Sequence[float], float]]) -> Law | None:
    """The law of one variable or of two, from points (values of the variables, y).

    None if there are no more points than unknowns, a variable does not vary, or two vary as one (`MAX_INFLATION`).
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
        # What no other variable explains of this one is what alone tells about its exponent (Frisch, Waugh, Lovell).
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
    """What is left of `values` after their regression on another variable, which may not vary."""
    if max(by) - min(by) < 1e-12:
        return _centred(values)
    slope, intercept = linear_regression(by, values)
    return [value - intercept - slope * x for value, x in zip(values, by, strict=True)]


def _rounded(number: float) -> float:
    """To six digits: more would promise too much, and differ in the last bits from machine to machine."""
    return float(f"{number:.6g}")
