"""Which blocks are older than which, so that every tie of phase 2 on a way goes as it does there.

Where any block may be the older (`Bounds.clocks_any`) a scenario says what the clocks showed.
"""

from collections.abc import Collection
from graphlib import CycleError, TopologicalSorter
from typing import Any

from harness.proof.model.block_renaming import Ordinals
from ucp.clock import MICROSECONDS


class Ages:
    """Takes down what the way asks for. Blocks are told by the numbers that they have in its states, which change."""

    def __init__(self) -> None:
        self._events: list[int] = []
        """For each block which of the events completes it."""
        self._older: dict[int, set[int]] = {}
        """For each event those with older blocks."""

    def completed(self, ordinal: int) -> None:
        """The next event completes this block."""
        assert ordinal == len(self._events) + 1, "blocks are numbered as they are completed"
        self._older[len(self._events)] = set()
        self._events.append(len(self._events))

    def renumber(self, blocks: Ordinals) -> None:
        """From now on these blocks are the first, the second, and so on; those that nobody has come after them."""
        if blocks:
            rest = [ordinal for ordinal in range(1, len(self._events) + 1) if ordinal not in blocks]
            self._events = [self._events[ordinal - 1] for ordinal in (*blocks, *rest)]

    def asked(self, oldest: int, others: Collection[int]) -> None:
        """One block has to be older than others; the inception block is, anyway."""
        for other in others if oldest else ():
            self._older[self._events[other - 1]].add(self._events[oldest - 1])

    def date(self, events: list[dict[str, Any]]) -> bool:
        """Let the events have timestamps of which that is true, if it is not true as they are.

        False if no timestamps make it true: a tie goes one way now and another way then, or an agent's clock goes back.
        """
        for index, event in enumerate(events):
            own = [earlier for earlier in range(index) if events[earlier]["agent"] == event["agent"]]
            self._older[index].update(own)  # an agent's clock does not go back
        if all(older < younger for younger, all_older in self._older.items() for older in all_older):
            return True
        try:
            in_order = [*TopologicalSorter(self._older).static_order()]
        except CycleError:
            return False
        moments = sorted(round(event["at_s"] * MICROSECONDS) for event in events)
        for index, timestamp_us in zip(in_order, moments, strict=True):
            events[index]["timestamp_us"] = timestamp_us
        return True
