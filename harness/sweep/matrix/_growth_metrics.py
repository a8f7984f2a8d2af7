"""Compute the numeric results that only a matrix with several swarm sizes or mission lengths needs."""

from harness.scenario import Scenario
from harness.sweep.matrix._estimate import BY_NAME as BY_NAME_IN_EVERY_MATRIX
from harness.sweep.matrix._estimate import Figures, Metric, figure

METRICS = (
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

BY_NAME = BY_NAME_IN_EVERY_MATRIX | {metric.name: metric for metric in METRICS}


def growth_figures(scenario: Scenario, mission_s: float, figures: Figures) -> Figures:
    """Return the numeric results of a run for laws of growth, derived from those of the checker.

    `mission_s`: the length of the run with the time to settle. Rates per minute are rates over that time.
    `load`: the number of blocks that are completed while one vote lasts. Only one vote at a time can succeed. At load 1
    and above, agents therefore complete blocks faster than they can commit them.
    `uniform_after_s`: seconds from the end of the mission until all chains were equal. It is negative if they became
    equal before the end, and None if they never did.
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
