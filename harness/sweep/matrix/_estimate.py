"""Estimate the means and shares of numeric results over several runs, with 95 % confidence intervals. Also compute the
numeric results that only a matrix with several swarm sizes or mission lengths needs.

A share of runs has the Wilson interval, which is also valid near 0 and 100 %. The interval of a mean comes from
Student's t distribution. A single run has no interval, because one value does not show the spread.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist, fmean, stdev
from typing import Literal

from pydantic import BaseModel, ConfigDict

from harness.scenario import Scenario

CONFIDENCE = 0.95


class Estimate(BaseModel):
    """The mean of a numeric result over `n` runs. `low` and `high` are the limits of its 95 % confidence interval. They
    are null for a single run. If there are no runs, `mean` is null too.
    """

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    n: int
    mean: float | None = None
    low: float | None = None
    high: float | None = None


def estimate_mean(values: Sequence[float], confidence: float = CONFIDENCE) -> Estimate:
    n = len(values)
    if n < 2:
        return Estimate(n=n, mean=values[0] if values else None)
    mean = fmean(values)
    margin = student_quantile((1 + confidence) / 2, n - 1) * stdev(values) / math.sqrt(n)
    return Estimate(n=n, mean=mean, low=mean - margin, high=mean + margin)


def estimate_share(count: int, n: int) -> Estimate:
    """Return the share `count` / `n` with its confidence interval (E. B. Wilson, 1927)."""
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
    """Return a quantile of Student's t distribution with `degrees` degrees of freedom. `probability` is above 0.5.

    The function uses bisection over angle = atan(t / sqrt(degrees)), because the distribution is a finite sum of
    functions of this angle.
    """
    low, high = 0.0, math.pi / 2
    while (middle := (low + high) / 2) not in (low, high):
        if (1 + _within(middle, degrees)) / 2 < probability:
            low = middle
        else:
            high = middle
    return math.tan(low) * math.sqrt(degrees)


def _within(angle: float, degrees: int) -> float:
    """Return the probability that a variable with Student's t distribution lies between -t and t (Abramowitz and
    Stegun, 26.7.3 and 26.7.4).
    """
    cosine = math.cos(angle)
    first = degrees % 2
    term, total = (cosine if first else 1.0), 0.0
    for index in range(first, degrees - 1, 2):
        total += term
        term *= (index + 1) / (index + 2) * cosine * cosine
    if first:
        return 2 / math.pi * (angle + math.sin(angle) * total)
    return math.sin(angle) * total


Figures = Mapping[str, float | int | None]


@dataclass(frozen=True, slots=True)
class Metric:
    """A kind of numeric result of a run."""

    name: str
    label: str
    of: Callable[[Figures], float | None]
    """A function that returns the value of the result in a run. It returns None if the run does not determine the
    result.
    """
    unit: Literal["share of runs", "share", "number"] = "number"
    """The kind of value: "share of runs" for a property that a run has or has not, "share" for a share within each run,
    and "number" for any other number.
    """
    worse: Literal["lower", "higher"] | None = None
    """The direction of change that counts as worse: lower or higher values. None if neither direction is worse."""

    def estimate(self, runs: Iterable[Figures]) -> Estimate:
        values = [value for figures in runs if (value := self.of(figures)) is not None]
        if self.unit == "share of runs":
            return estimate_share(round(sum(values)), len(values))
        return estimate_mean(values)


def figure(name: str) -> Callable[[Figures], float | None]:
    return lambda figures: figures.get(name)


def uniform(figures: Figures, when: str = "") -> float | None:
    chains = figures.get(f"distinct_chains{when}")
    return None if chains is None else float(chains == 1)


def _mutual_share(figures: Figures, when: str = "") -> float | None:
    mutual, blocks = figures.get(f"mutual_chain{when}"), figures.get("blocks")
    return None if mutual is None or not blocks else mutual / blocks


def _before_final_reconcile(share: Callable[[Figures, str], float | None]) -> Callable[[Figures], float | None]:
    return lambda figures: share(figures, "_before_final_reconcile")


METRICS = (
    Metric("uniform", "one chain", uniform, "share of runs", worse="lower"),
    Metric("mutual_share", "mutual chain", _mutual_share, "share", worse="lower"),
    Metric("distinct_chains", "distinct chains", figure("distinct_chains"), worse="higher"),
    Metric("reconciles", "reconciles", figure("reconciles"), worse="higher"),
    Metric("copies_mean", "copies mean", figure("copies_mean"), worse="lower"),
    Metric("copies_min", "copies fewest", figure("copies_min"), worse="lower"),
    Metric("messages_per_block", "messages per block", figure("messages_per_block"), worse="higher"),
)
BEFORE_FINAL_RECONCILE = (
    Metric(
        "uniform_before_final_reconcile",
        "one chain before final reconcile",
        _before_final_reconcile(uniform),
        "share of runs",
        worse="lower",
    ),
    Metric(
        "mutual_share_before_final_reconcile",
        "mutual chain before final reconcile",
        _before_final_reconcile(_mutual_share),
        "share",
        worse="lower",
    ),
)
"""Metrics of the swarm before a final reconcile. A final reconcile makes all chains equal, so later values hardly
depend on the network.
"""
BY_NAME = {metric.name: metric for metric in METRICS + BEFORE_FINAL_RECONCILE}


GROWTH_METRICS = (
    Metric("blocks", "blocks", figure("blocks")),
    Metric("load", "load", figure("load")),
    Metric("committed_per_minute", "chain blocks /min", figure("committed_per_minute")),
    Metric("reconciles_per_block", "recon- ciles /block", figure("reconciles_per_block")),
    Metric("messages_per_minute", "messages /min", figure("messages_per_minute")),
    Metric("messages", "messages", figure("messages")),
    Metric("bytes", "bytes", figure("bytes")),
    Metric("uniform_after_s", "uniform after s", figure("uniform_after_s")),
)
FITTED = ("messages", "bytes", "messages_per_block", "messages_per_minute", "reconciles_per_block", "uniform_after_s")
"""Metrics to which power laws are fitted."""

GROWTH_BY_NAME = BY_NAME | {metric.name: metric for metric in GROWTH_METRICS}


def growth_figures(scenario: Scenario, mission_s: float, figures: Figures) -> Figures:
    """Return the numeric results of a run to which power laws are fitted. They are computed from the results of the
    checker.

    `mission_s` is the length of the run, including the time to settle. Rates per minute refer to this time. `load` is
    the number of blocks that are completed during one vote. Only one vote at a time can succeed, so at load 1 and
    above, agents complete blocks faster than they can commit them. `uniform_after_s` is the number of seconds from the
    end of the mission until all chains were equal. It is negative if they became equal before the end, and None if they
    never did.
    """
    blocks, longest, reconciles, uniform_at_s = (
        figures.get(name) for name in ("blocks", "longest_chain", "reconciles", "uniform_at_s")
    )

    def per_minute(count: float | None) -> float | None:
        return None if count is None or not mission_s else round(60 * count / mission_s, 4)

    return {
        "mission_s": mission_s,
        "load": None if blocks is None else round(blocks * scenario.settings.vote_timeout_s / scenario.duration_s, 4),
        "committed_per_minute": per_minute(longest),
        "messages_per_minute": per_minute(figures.get("messages")),
        "reconciles_per_block": round(reconciles / blocks, 4) if blocks and reconciles is not None else None,
        "uniform_after_s": None if uniform_at_s is None else round(uniform_at_s - scenario.duration_s, 3),
    }
