"""What is measured of each run, from the checker's figures. One list for the table, the files and the picture."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from harness.sweep.matrix.estimate import Estimate, estimate_mean, estimate_share

Figures = Mapping[str, float | int | None]


@dataclass(frozen=True, slots=True)
class Metric:
    """`of` is None for a run that does not tell. `unit`: a share of the runs, a share in each run, or a number.

    `worse`: which direction is, None if neither.
    """

    name: str
    label: str
    of: Callable[[Figures], float | None]
    unit: Literal["share of runs", "share", "number"] = "number"
    worse: Literal["lower", "higher"] | None = None

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
"""Known only where the scenario has a final reconcile, after which the others say little of the network."""
BY_NAME = {metric.name: metric for metric in METRICS + BEFORE_FINAL_RECONCILE}
