"""What the agents' clocks show beside each other, from messages alone.

Between two agents every message says that it was received after it was sent. With t by the clock of A and u by that of
B, messages from A to B are points (t sent, u received) above the line that leads from one clock to the other, messages
from B to A are points (t received, u sent) below it: the nearer, the faster they were. The line taken is the one with
the most room between both, as in synchronising traces by NTP's minimal delays; a line is an offset and a drift.
If no drift fits as well, none is assumed: a few messages do not show one.

No clock is believed more than another: that of the agent with whom the most messages were exchanged is the measure.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

SLOWEST, FASTEST = 0.55, 1.8
"""Rates beyond these are no clock's."""
SEARCH_STEPS = 100
POINTS_FOR_DRIFT = 8
"""Messages each way that it takes to speak of drift."""
OFFSET_DIGITS, DRIFT_DIGITS = 6, 9


@dataclass(frozen=True)
class Line:
    """A clock beside another: it shows offset_s + rate * t when the other shows t."""

    offset_s: float = 0.0
    rate: float = 1.0

    def shows(self, t: float) -> float:
        return self.offset_s + self.rate * t

    def at(self, shown: float) -> float:
        """When it shows that."""
        return (shown - self.offset_s) / self.rate

    def after(self, first: "Line") -> "Line":
        """This clock beside that one beside which `first` is the clock between."""
        return Line(self.shows(first.offset_s), self.rate * first.rate)

    def inverse(self) -> "Line":
        return Line(-self.offset_s / self.rate, 1 / self.rate)


Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Delivery:
    """A message on its way, each end by the clock of the agent there."""

    sender: int
    receiver: int
    sent_s: float
    received_s: float


def estimate(agents: Iterable[int], deliveries: Iterable[Delivery]) -> dict[int, Line]:
    """Each agent's clock beside the measure; as good as the measure where no message says anything."""
    between: dict[tuple[int, int], tuple[list[Point], list[Point]]] = defaultdict(lambda: ([], []))
    for delivery in deliveries:
        if delivery.sender < delivery.receiver:
            above, _ = between[delivery.sender, delivery.receiver]
            above.append((delivery.sent_s, delivery.received_s))
        else:
            _, below = between[delivery.receiver, delivery.sender]
            below.append((delivery.received_s, delivery.sent_s))
    weight = {
        pair: min(len(above), len(below)) + 1e-3 * (len(above) + len(below)) for pair, (above, below) in between.items()
    }
    total: dict[int, float] = dict.fromkeys(agents, 0.0)
    for (a, b), heavy in weight.items():
        total[a] += heavy
        total[b] += heavy
    clocks: dict[int, Line] = {}
    while left := [agent for agent in total if agent not in clocks]:
        links = [(heavy, pair) for pair, heavy in weight.items() if (pair[0] in clocks) != (pair[1] in clocks)]
        if not links:
            measure = max(left, key=lambda agent: (total[agent], -agent))
            clocks[measure] = Line()
            continue
        _, (a, b) = max(links)
        line = fit(*between[a, b])
        if a in clocks:
            clocks[b] = line.after(clocks[a])
        else:
            clocks[a] = line.inverse().after(clocks[b])
    return clocks


def _height(hull: list[Point], rate: float, of: Callable[[Iterator[float]], float]) -> float:
    """Where the line with this rate crosses t = 0 that touches the hull."""
    return of(u - rate * t for t, u in hull)


def _hull(points: list[Point], side: int) -> list[Point]:
    """Of the points those that a line can touch from below (side 1), or from above (-1)."""
    hull: list[Point] = []
    for t, u in sorted(points, key=lambda point: (point[0], side * point[1])):
        if hull and hull[-1][0] == t:
            continue
        while len(hull) > 1 and side * _turn(hull[-2], hull[-1], (t, u)) <= 0:
            hull.pop()
        hull.append((t, u))
    return hull


def _turn(a: Point, b: Point, c: Point) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def fit(above: list[Point], below: list[Point]) -> Line:
    """The line with the points of one list above it and those of the other below it, and the most room between."""
    lower, upper = _hull(above, 1), _hull(below, -1)

    def room(rate: float) -> float:
        return _height(lower, rate, min) - _height(upper, rate, max)

    rate = 1.0
    if min(len(above), len(below)) >= POINTS_FOR_DRIFT and room(1.0) < 0:
        low, high = SLOWEST, FASTEST
        for _ in range(SEARCH_STEPS):  # room is concave
            third = (high - low) / 3
            if room(low + third) < room(high - third):
                low += third
            else:
                high -= third
        rate = (low + high) / 2
    if above and below:
        return Line((_height(lower, rate, min) + _height(upper, rate, max)) / 2, rate)
    return Line(_height(lower, rate, min) if above else _height(upper, rate, max), rate)
