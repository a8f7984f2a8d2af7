"""What is measured of each run: one list for the table, the files, the fits and the picture.

Most of it is virtual, and the same on every machine. What a run costs this machine is kept apart.
"""

from harness.checker import Result
from harness.play.mission import RunOutcome
from harness.scenario import Scenario
from harness.sweep.matrix._estimate import Figures, Metric, figure, uniform

METRICS = (
    Metric("blocks", "blocks", figure("blocks")),
    Metric("load", "load", figure("load")),
    Metric("uniform", "one chain", uniform, "share of runs"),
    Metric("settled", "idle at end", figure("settled"), "share of runs"),
    Metric("mutual_share", "mutual chain", figure("mutual_share"), "share"),
    Metric("committed_per_minute", "chain blocks /min", figure("committed_per_minute")),
    Metric("reconciles_per_block", "recon- ciles /block", figure("reconciles_per_block")),
    Metric("messages_per_block", "messages /block", figure("messages_per_block")),
    Metric("messages_per_minute", "messages /min", figure("messages_per_minute")),
    Metric("messages", "messages", figure("messages")),
    Metric("bytes", "bytes", figure("bytes")),
    Metric("uniform_after_s", "uniform after s", figure("uniform_after_s")),
)
MACHINE_METRICS = (
    Metric("processor_s", "proces- sor s", figure("processor_s")),
    Metric("wall_s", "wall s", figure("wall_s")),
)
FITTED = ("messages", "bytes", "messages_per_block", "messages_per_minute", "reconciles_per_block", "uniform_after_s")
"""Metrics that power laws are fitted to, and the machine's besides."""

BY_NAME = {metric.name: metric for metric in (*METRICS, *MACHINE_METRICS)}


def measure(scenario: Scenario, played: RunOutcome, result: Result) -> Figures:
    """The checker's figures, and what follows from them.

    `load`: the blocks completed in the time that a vote takes. One vote at a time can succeed, so from 1 on they come
    faster than they can be committed. `uniform_after_s`: when all chains became one, counted from the mission's end;
    negative if before, None if never. What is per minute counts the settling: the messages, and the blocks that the
    longest chain has.
    """
    figures = result.figures
    blocks, uniform_at_s = figures.get("blocks"), figures.get("uniform_at_s")
    longest, mutual, reconciles = (figures.get(name) for name in ("longest_chain", "mutual_chain", "reconciles"))

    def per_minute(count: float | None) -> float | None:
        return None if count is None or not played.mission_s else round(60 * count / played.mission_s, 4)

    return {
        **figures,
        "load": None if blocks is None else round(blocks * scenario.settings.vote_timeout_s / scenario.duration_s, 4),
        "settled": int(played.settled),
        "mission_s": played.mission_s,
        "mutual_share": round(mutual / blocks, 4) if blocks and mutual is not None else None,
        "committed_per_minute": per_minute(longest),
        "messages_per_minute": per_minute(figures.get("messages")),
        "reconciles_per_block": round(reconciles / blocks, 4) if blocks and reconciles is not None else None,
        "uniform_after_s": None if uniform_at_s is None else round(uniform_at_s - scenario.duration_s, 3),
    }
