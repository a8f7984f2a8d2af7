"""A timeline that grows while it is played: whoever tells what happens now adds an entry of a scenario's timeline.

So what is told is checked as an entry is, and made by the same code; and it can be played again, from the scenario that
it has come to.
"""

import math
import re
from typing import Any

from harness.errors import ScenarioError
from harness.play.mission import Swarm
from harness.scenario import Scenario
from harness.scenario.changes import Change, timeline_of
from harness.scenario.load import parse

INSTANT_S = 0.001
"""Of two entries in one instant the second comes a millisecond later."""

_NAMED = re.compile(r"(?P<list>timeline|fates)\.(?P<number>\d+)(?P<rest>\.|: )?")


class GrowingTimeline:
    """What is played of a scenario by now, and may yet be added to it."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        """With everything in its timeline that was told by now."""
        self._played_s = 0.0
        """Until when the timeline has been played."""

    def next_instant(self, swarm: Swarm) -> float:
        """The first whole millisecond, in mission seconds, at which something may happen that is told now."""
        return math.ceil(max(swarm.now(), self._played_s + INSTANT_S) * 1000) / 1000

    def retell(self, document: dict[str, Any]) -> None:
        """From now on this is the scenario. Raises ScenarioError if there can be no such scenario."""
        try:
            self.scenario = parse(document)
        except ScenarioError as error:
            raise ScenarioError(_of_the_last(str(error), document["timeline"])) from None

    async def until(self, swarm: Swarm, mission_s: float) -> None:
        """Go on until then, with what the timeline has in between."""
        for change in [change for change in timeline_of(self.scenario) if self._played_s < change.at_s <= mission_s]:
            await swarm.until(change.at_s)
            await swarm.apply(self.as_asked(change))
            self._played_s = change.at_s
        await swarm.until(mission_s)

    def as_asked(self, change: Change) -> Change:
        """The change, with what is known of who asked for it."""
        return change


def _of_the_last(problem: str, timeline: list[dict[str, Any]]) -> str:
    """What is wrong with a timeline, in the words of whoever told its last entry."""
    last = len(timeline) - 1

    def name(named: re.Match[str]) -> str:
        number, rest = int(named["number"]), named["rest"]
        if named["list"] == "fates" or number >= last:
            return "" if rest else "this"
        return f"the timeline's entry at {timeline[number]['at_s']:g} s{', ' if rest == '.' else rest or ''}"

    return _NAMED.sub(name, problem)
