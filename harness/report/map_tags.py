"""Vehicles' IDs on a map, each beside its place where it covers neither a place nor another ID."""

from collections.abc import Mapping, Sequence

from markupsafe import Markup

from harness.present.colours import Ink
from harness.present.svg import n
from harness.report.map_geometry import Point, Projection

HEIGHT, DIGIT, PADDING = 16, 7.5, 8
NEAR, FAR = 14, 34
"""From a place to the middle of its tag, in pixels, where the tag is above it."""
_WAYS = ((0, -1), (0, 1), (1, -1), (-1, -1), (1, 1), (-1, 1), (1, 0), (-1, 0))

Box = tuple[float, float, float, float]
"""Left, top, right, bottom."""


def tags(
    tagged: Sequence[tuple[int, Point]], crosses: Sequence[Point], to_px: Projection, ink: Mapping[int, Ink]
) -> Markup:
    """Clear of the `crosses`, too. Who finds no room has only the tooltip of its place."""
    taken = [(x - 5, y - 5, x + 5, y + 5) for x, y in (*(place for _, place in tagged), *crosses)]
    drawn = []
    for vehicle, place in tagged:
        for box in _boxes(len(str(vehicle)), place):
            if _inside(box, to_px) and not any(_overlap(box, taken_box) for taken_box in taken):
                taken.append(box)
                drawn.append(_tag(vehicle, box, place, ink[vehicle]))
                break
    return Markup("").join(drawn)


def _boxes(digits: int, place: Point) -> list[Box]:
    """All that come into question, the best first."""
    width = digits * DIGIT + PADDING
    boxes = []
    for distance in (NEAR, FAR):
        for right, down in _WAYS:
            x = place[0] + right * (distance - HEIGHT / 2 + width / 2)
            y = place[1] + down * distance
            boxes.append((x - width / 2, y - HEIGHT / 2, x + width / 2, y + HEIGHT / 2))
    return boxes


def _tag(vehicle: int, box: Box, place: Point, ink: Ink) -> Markup:
    left, top, right, bottom = box
    x, y = (left + right) / 2, (top + bottom) / 2
    leader = Markup('<path class="leader" d="M{} {}L{} {}"/>').format(n(place[0]), n(place[1]), n(x), n(y))
    return Markup(
        '{}<rect x="{}" y="{}" width="{}" height="{}" rx="3" fill="{}" stroke="{}"{}/>'
        '<text x="{}" y="{}" text-anchor="middle" fill="{}">{}</text>'
    ).format(
        leader if abs(y - place[1]) > HEIGHT or abs(x - place[0]) > right - left + HEIGHT else "",
        n(left),
        n(top),
        n(right - left),
        n(bottom - top),
        ink.fill,
        ink.stroke,
        Markup(' stroke-dasharray="4 2"') if ink.dashed else "",
        n(x),
        n(y + 4.3),
        ink.text,
        vehicle,
    )


def _inside(box: Box, to_px: Projection) -> bool:
    left, top, right, bottom = box
    return (
        left >= to_px.left
        and top >= to_px.top
        and right <= to_px.left + to_px.width
        and bottom <= to_px.top + to_px.height
    )


def _overlap(first: Box, second: Box) -> bool:
    return first[0] < second[2] and second[0] < first[2] and first[1] < second[3] and second[1] < first[3]
