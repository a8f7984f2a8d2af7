"""Draw lines for the radio links between moving vehicles.

The lines are updated after vehicles have moved, at most once per mission second. The number of links grows with the
square of the number of vehicles, so the lines of large swarms are updated less often.
"""

from itertools import combinations
from typing import NamedTuple

from harness.archive.connectivity import Link
from harness.report.export._samples import FieldPosition, Metres

FIELD = "field"
"""Name of the coordinate frame of the field: x is east, y north and z up, in metres from the centre of the field."""
PAIRS_A_SECOND = 100


def vehicle_frame(vehicle: int) -> str:
    """Return the name of the coordinate frame that moves with the vehicle."""
    return f"vehicle_{vehicle}"


class LinkLine(NamedTuple):
    """A line that represents the link between two vehicles. `loss` is the larger loss rate of the two directions, and
    is below 1.
    """

    low: Metres
    high: Metres
    loss: float

    @property
    def colour(self) -> dict[str, float]:
        """The colour of the link as red, green, blue and opacity, each from 0 to 1. Green means no loss, and faint red
        means a high loss rate.
        """
        return {"r": self.loss, "g": 1.0 - self.loss, "b": 0.1, "a": 1.0 - 0.7 * self.loss}


class CurrentLinks:
    """The current positions of the vehicles, and the current loss rates of the links between them."""

    def __init__(self) -> None:
        self.losses: dict[Link, float] = {}
        self._places: dict[int, Metres] = {}
        self._drawn_ns: int | None = None
        self._moved_ns = -1

    def move(self, position: FieldPosition) -> list[LinkLine] | None:
        """Store a new position.

        If it is time to update the lines, return the lines that belong to the previous positions. Return None
        otherwise. All vehicles report their positions at the same times. When the first later position arrives, the
        lines for one time are therefore complete.
        """
        at_ns = position.at_ns
        due = at_ns > self._moved_ns and self._are_due(at_ns)
        lines = self._lines() if due else None
        self._drawn_ns = at_ns if due else self._drawn_ns
        self._places[position.vehicle] = position.metres
        self._moved_ns = at_ns
        return lines

    def _are_due(self, at_ns: int) -> bool:
        pairs = len(self._places) * (len(self._places) - 1) // 2
        every_ns = max(1.0, pairs / PAIRS_A_SECOND) * 1e9
        return bool(self.losses and pairs) and (self._drawn_ns is None or at_ns - self._drawn_ns >= every_ns)

    def _lines(self) -> list[LinkLine]:
        lines = []
        for low, high in combinations(sorted(self._places), 2):
            loss = max(self.losses.get((low, high), 1.0), self.losses.get((high, low), 1.0))
            if loss < 1.0:
                lines.append(LinkLine(self._places[low], self._places[high], loss))
        return lines
