"""The disk space that the traces of a run need: an estimate before the start, and a quota, which ensures that the disk
does not become full.

Each agent that receives a message writes a line to its trace, so traces grow with the third power of the number of
agents, or faster. A trace ends at its quota in the same way as on a full disk: after a complete line, and with a reason
in `run.json`. Without a quota, the traces would leave no space for exports, verdict and report.

The quota counts the lines of a trace before they are packed, because a busy machine packs them late. The kernel
enforces the quota as the maximum size of a file.
"""

import math
import shutil
from itertools import pairwise
from pathlib import Path

from harness.archive.bounded_file import can_free_parts
from harness.archive.trace_files import MAX_TRACE_BYTES, PACKED_FROM_BYTES, PACKED_SHARE
from harness.scenario import Scenario

MEGABYTE = 1_000_000
SHARE_OF_FREE_SPACE = 0.5
LEAST_BYTES_PER_AGENT = 8 * MEGABYTE
"""Minimum space for the files of an agent, in bytes. Besides the trace, these are the export and the stored state,
which are much smaller.
"""
MEAN_S = 30.0
MESSAGES_PER_MINUTE = ((2, 4), (5, 38), (10, 229), (15, 885), (20, 2010), (30, 6050), (50, 25_500), (100, 90_700))
"""Messages per minute for some numbers of agents, if each agent logs an event every 30 s (docs/appendix/growth.md)."""
BYTES_PER_LINE = 800
LINES_WITHOUT_IDLE_RECEIPTS = 2
"""Average number of trace lines per message in virtual time. It is small, because virtual time delivers a message only
to agents that it can affect.
"""


def trace_quota(scenario: Scenario, directory: Path) -> int:
    """Return the maximum size of one agent's trace before packing, in bytes."""
    free = shutil.disk_usage(_existing(directory)).free
    total = free * SHARE_OF_FREE_SPACE if scenario.trace_quota_mb is None else scenario.trace_quota_mb * MEGABYTE
    return min(MAX_TRACE_BYTES, max(LEAST_BYTES_PER_AGENT, round(total / len(scenario.roster))))


def estimated_bytes(scenario: Scenario, *, all_delivered: bool) -> int:
    """Return the estimated size of all traces together before packing.

    If `all_delivered` is true, traces also record messages that have no effect, as the traces of processes do.
    """
    agents = len(scenario.roster)
    messages = _messages_per_minute(agents) * scenario.duration_s / 60
    if scenario.events.source == "random":
        messages *= MEAN_S / scenario.events.mean_s
    return round(messages * (agents if all_delivered else LINES_WITHOUT_IDLE_RECEIPTS) * BYTES_PER_LINE)


def space_sentence(scenario: Scenario, directory: Path, *, all_delivered: bool) -> tuple[str, str]:
    """Return two texts: a remark about large traces, and a warning if the traces will probably not fit on the disk.
    Both are empty if the traces are small.
    """
    expected = estimated_bytes(scenario, all_delivered=all_delivered)
    quota = trace_quota(scenario, directory) * len(scenario.roster)
    if expected < PACKED_FROM_BYTES and expected < quota:
        return "", ""
    packed = _size(expected * PACKED_SHARE)
    when = "during the run" if can_free_parts(_existing(directory)) else "after the run"
    remark = f"traces: about {_size(expected)}, packed to about {packed} {when}"
    if expected < quota:
        return remark, ""
    return remark, (
        f"the traces will probably end early, because their quota is {_size(quota)} ({_source(scenario, quota)}), and "
        "the run will then not be judged completely: raise the quota, or choose fewer agents or a shorter mission"
    )


def _source(scenario: Scenario, quota: int) -> str:
    """Return a phrase that explains why all traces together have this quota."""
    if quota == LEAST_BYTES_PER_AGENT * len(scenario.roster):
        return "the least for each agent"
    if quota == MAX_TRACE_BYTES * len(scenario.roster):
        return "the most that can be judged"
    return "half of the free disk space" if scenario.trace_quota_mb is None else "`trace_quota_mb`"


def _messages_per_minute(agents: int) -> float:
    """Return the messages per minute of a swarm with this number of agents. The function interpolates the table on a
    logarithmic scale, and extrapolates beyond its ends.
    """
    steps = [*pairwise(MESSAGES_PER_MINUTE)]
    (low, few), (high, many) = next((step for step in steps if agents <= step[1][0]), steps[-1])
    exponent = math.log(many / few) / math.log(high / low)
    return float(few * (agents / low) ** exponent)


def _size(size_bytes: float) -> str:
    return f"{size_bytes / 1e9:.1f} GB" if size_bytes >= 1e9 else f"{size_bytes / 1e6:.0f} MB"


def _existing(directory: Path) -> Path:
    """Return the directory, or the nearest directory above it that exists."""
    return next(path for path in (directory.absolute(), *directory.absolute().parents) if path.exists())
