"""A share or a mean of many runs, with its 95 % interval.

A share of runs has Wilson's interval, which stays honest at 0 and 100 %; a mean has Student's. One run has none: it
tells nothing about the spread of others.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from statistics import NormalDist, fmean, stdev

from pydantic import BaseModel, ConfigDict

CONFIDENCE = 0.95


class Estimate(BaseModel):
    """`mean` of `n` runs; `low` and `high` bound its 95 % interval, null for a single run; all null for none."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    n: int
    mean: float | None = None
    low: float | None = None
    high: float | None = None


def estimate_mean(values: Sequence[float]) -> Estimate:
    n = len(values)
    if n < 2:
        return Estimate(n=n, mean=values[0] if values else None)
    mean = fmean(values)
    margin = student_quantile((1 + CONFIDENCE) / 2, n - 1) * stdev(values) / math.sqrt(n)
    return Estimate(n=n, mean=mean, low=mean - margin, high=mean + margin)


def estimate_share(count: int, n: int) -> Estimate:
    """The share of `n` runs that `count` of them are (E. B. Wilson, 1927)."""
    if n < 2:
        return Estimate(n=n, mean=float(count) if n else None)
    z = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)
    share = count / n
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    margin = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    low, high = max(0.0, centre - margin), min(1.0, centre + margin)
    return Estimate(n=n, mean=share, low=0.0 if count == 0 else low, high=1.0 if count == n else high)


@lru_cache
def student_quantile(probability: float, degrees: int) -> float:
    """Where Student's t distribution of so many degrees of freedom reaches `probability`, above 0.5.

    Bisection in angle = atan(t / sqrt(degrees)), in which the distribution is a finite sum.
    """
    low, high = 0.0, math.pi / 2
    while (middle := (low + high) / 2) not in (low, high):
        if (1 + _within(middle, degrees)) / 2 < probability:
            low = middle
        else:
            high = middle
    return math.tan(low) * math.sqrt(degrees)


def _within(angle: float, degrees: int) -> float:
    """How much of Student's distribution lies within +-t (Abramowitz and Stegun, 26.7.3 and 26.7.4)."""
    cosine = math.cos(angle)
    first = degrees % 2
    term, total = (cosine if first else 1.0), 0.0
    for index in range(first, degrees - 1, 2):
        total += term
        term *= (index + 1) / (index + 2) * cosine * cosine
    if first:
        return 2 / math.pi * (angle + math.sin(angle) * total)
    return math.sin(angle) * total
