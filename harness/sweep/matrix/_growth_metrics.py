"""Compute the numeric results that are needed only for a matrix with several swarm sizes or mission lengths."""

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
