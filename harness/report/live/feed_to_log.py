"""Write the stream of changes to the log. The changes of an active run are written as they occur, and the changes of a
finished run all at once.
"""

import asyncio

from harness.report.live.change_log import ChangeLog
from harness.report.live.feed import ChangeFeed, RunClock
from harness.report.live.server import UPDATE_S

STRIDE_S = 20.0
"""Mission seconds of a finished run that are read from all files in one step."""


async def copy_finished_run(feed: ChangeFeed, log: ChangeLog) -> None:
    """Write all changes of a finished run to a log, in order of time."""
    until_s = 0.0
    log.append([feed.run_change(live=False)])
    while True:
        changes, more = feed.poll(until_s)
        log.append(changes)
        await asyncio.sleep(0)
        if more:
            continue
        if (next_s := feed.next_s) is None:
            break
        until_s = max(until_s, next_s) + STRIDE_S
    log.append(feed.final_changes())


async def copy_live_run(feed: ChangeFeed, log: ChangeLog, ended: asyncio.Event, clock: RunClock) -> None:
    """Write the changes of an active run to a log until the run has a result. Also stop when the event `ended` is set,
    which means that the process of the run has ended. `clock` contains the mission seconds that the run reported.
    """
    log.append([feed.run_change(live=True)])
    while True:
        over = feed.over or ended.is_set()
        changes, more = feed.poll_live(clock)
        log.append(changes)
        if over and not more:
            break
        await asyncio.sleep(0 if more else UPDATE_S)
    log.append(feed.final_changes())
