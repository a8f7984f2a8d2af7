"""Create runs to watch on the live page."""

from pathlib import Path
from typing import Any

from harness.report.live._agent_course import Change
from harness.report.live.feed import ChangeFeed
from tests.harness.field.flights import flown

PLAYED = {
    "agents": 4,
    "duration_s": 200,
    "events": {"mean_s": 8},
    "network": {"loss": 0.1, "radio": {"hard_range": {"range_m": 5000}}},
    "timeline": [
        {"at_s": 40, "partition": [[1, 2], [3, 4]]},
        {"at_s": 100, "heal": True},
        {"at_s": 120, "kill": [4]},
        {"at_s": 150, "restart": [4]},
    ],
}


def played(directory: Path, **keys: Any) -> Path:
    """Play a simulated run with positions of vehicles, a partition, and a vehicle that is lost and comes back."""
    return flown(directory, **{**PLAYED, **keys})


def film(directory: Path, stride_s: float = 20.0) -> list[Change]:
    """Return all changes of a finished run for the live page. The feed reads `stride_s` mission seconds at a time."""
    feed = ChangeFeed(directory)
    feed_changes, until_s = [feed.run_change(live=False)], 0.0
    while True:
        changes, more = feed.poll(until_s)
        feed_changes += changes
        if more:
            continue
        if (next_s := feed.next_s) is None:
            break
        until_s = max(until_s, next_s) + stride_s
    feed_changes += feed.final_changes()
    feed.close()
    return feed_changes


def of_kind(kind: str, feed_changes: list[Change]) -> list[Change]:
    return [change for change in feed_changes if change[0] == kind]
