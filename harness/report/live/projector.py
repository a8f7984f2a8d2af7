"""Reads a run directory into a story and shows it: a run that goes on look by look, one that is over at once."""

import asyncio

from harness.report.live.change_log import Story
from harness.report.live.feed import Feed
from harness.report.live.server import UPDATE_S

STRIDE_S = 20.0
"""Mission seconds that are read at once of a run that is over: all agents' traces side by side."""


async def tell_film(feed: Feed, story: Story) -> None:
    """The run is over: tell all of it, in order."""
    until_s = 0.0
    story.tell([feed.first(live=False)])
    while True:
        changes, more = feed.look(until_s)
        story.tell(changes)
        await asyncio.sleep(0)
        if more:
            continue
        if (next_s := feed.next_s) is None:
            break
        until_s = max(until_s, next_s) + STRIDE_S
    story.tell(feed.last())


async def tell_live(feed: Feed, story: Story, ended: asyncio.Event) -> None:
    """The run goes on until its record says that it is over, or `ended` is set: whoever played it is gone."""
    story.tell([feed.first(live=True)])
    while True:
        over = feed.over or ended.is_set()
        changes, more = feed.look()
        story.tell(changes)
        if over and not more:
            break
        await asyncio.sleep(0 if more else UPDATE_S)
    story.tell(feed.last())
