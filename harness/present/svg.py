"""Draw the common parts of charts: axes with ticks, marks, and an SVG file with several charts.

Colours are attributes, so that programs without style sheets also draw the chart. `chart.css` adds a dark scheme.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup, escape

STYLE = (Path(__file__).parent / "chart.css").read_text(encoding="utf-8")

WIDTH, MARGIN = 900, 16
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', 'DejaVu Sans', sans-serif"
INK, QUIET, RULE, GROUND = "#1c2126", "#57616b", "#d9dee2", "#ffffff"
COLOURS = ("#0072b2", "#a83900", "#00785a", "#8a3f74")
"""Colours of the lines in a chart: hues of Okabe and Ito, dark enough for text on a white background."""
MOST_LOG_TICKS = 6
CLASSES = ("first", "second", "third", "fourth")
DASHES = ("", "6 3", "2 3", "9 3 2 3")
TITLE_LENGTH = 80

_LEFT, _RIGHT, _TOP, _BOTTOM = 48, 18, 34, 40  # margins of a panel around its axes


@dataclass(frozen=True, slots=True)
class Axis:
    """A mapping from values to pixels. If `log` is true, the mapping is logarithmic and all values must be above 0."""

    first: float
    last: float
    start: float
    end: float
    ticks: Sequence[float]
    log: bool = False

    def __call__(self, value: float) -> float:
        first, last, inside = self.first, self.last, min(max(value, self.first), self.last)
        if self.log:
            first, last, inside = math.log(first), math.log(last), math.log(inside)
        return self.start + (inside - first) / (last - first) * (self.end - self.start)


@dataclass(frozen=True, slots=True)
class ChartArea:
    """The rectangle of a chart in a picture."""

    x: float
    y: float
    width: float
    height: float

    @property
    def across(self) -> tuple[float, float]:
        """The left and the right end of the horizontal axis, in pixels."""
        return self.x + _LEFT, self.x + self.width - _RIGHT

    @property
    def up(self) -> tuple[float, float]:
        """The bottom and the top of the vertical axis, in pixels."""
        return self.y + self.height - _BOTTOM, self.y + _TOP


def grid(count: int, columns: int, top: float, height: float) -> list[ChartArea]:
    """Return the rectangles of `count` charts, row by row. The first row begins at the height `top`."""
    width = (WIDTH - 2 * MARGIN) / columns
    return [
        ChartArea(MARGIN + at % columns * width, top + at // columns * height, width, height) for at in range(count)
    ]


def linear_axis(first: float, last: float, place: tuple[float, float]) -> Axis:
    """Return an axis from `first` to `last` with ticks at round numbers."""
    every = step(last - first, 5)
    ticks = [number * every for number in range(math.ceil(first / every - 1e-9), math.floor(last / every + 1e-9) + 1)]
    return Axis(first, last, *place, ticks)


def share_axis(place: tuple[float, float]) -> Axis:
    """Return an axis for shares from 0 to 1, with a tick at each quarter. `place` is its start and end in pixels."""
    return Axis(0.0, 1.0, *place, [0.0, 0.25, 0.5, 0.75, 1.0])


def log_axis(first: float, last: float, place: tuple[float, float]) -> Axis:
    """Return a logarithmic axis that covers `first` to `last`, with at most `MOST_LOG_TICKS` ticks.

    The ticks are powers of ten, with further values between them if there is room.
    """
    for factors, every in (((1, 2, 5), 1), ((1, 3), 1), *(((1,), decades) for decades in range(1, 700))):
        begin, end = math.floor(math.log10(first) / every) * every, math.ceil(math.log10(last) / every + 1e-9) * every
        ticks = [factor * 10.0**power for power in range(begin, end + 1, every) for factor in factors]
        low = max((tick for tick in ticks if tick <= first * (1 + 1e-9)), default=first)
        high = min((tick for tick in ticks if tick >= last * (1 - 1e-9) and tick > low), default=last)
        inside = [tick for tick in ticks if low <= tick <= high]
        if len(inside) <= MOST_LOG_TICKS:
            break
    return Axis(low, high, *place, inside, log=True)


def step(span: float, most: int) -> float:
    """Return the tick distance of an axis: the smallest round number (1, 2, 2.5 or 5 times a power of ten) that divides
    `span` into at most `most` parts.
    """
    unit: float = 10.0 ** math.floor(math.log10(span / most))
    return next(factor * unit for factor in (1, 2, 2.5, 5, 10) if factor * unit * most >= span * (1 - 1e-9))


def frame(title: str, across: Axis, up: Axis, across_texts: Iterable[str], up_texts: Iterable[str]) -> Markup:
    """Draw the parts of a chart other than its data: title, grid lines and ticks."""
    parts = [
        Markup('<text x="{}" y="{}" font-weight="600" fill="{}">{}</text>').format(
            n(across.start - _LEFT + 4), n(up.end - _TOP + 16), INK, title
        )
    ]
    for tick, text in zip(up.ticks, up_texts, strict=True):
        base = up(tick) == up.start
        parts.append(
            Markup('<path class="{}" d="M{} {}H{}" stroke="{}"/>').format(
                "base" if base else "rule", n(across.start), n(up(tick)), n(across.end), QUIET if base else RULE
            )
        )
        parts.append(_tick(across.start - 7, up(tick) + 4, "end", text))
    for tick, text in zip(across.ticks, across_texts, strict=True):
        parts.append(
            Markup('<path class="base" d="M{} {}v4" stroke="{}"/>').format(n(across(tick)), n(up.start), QUIET)
        )
        parts.append(_tick(across(tick), up.start + 18, "middle", text))
    return Markup("").join(parts)


def line(points: Iterable[tuple[float, float]], number: int) -> Markup:
    """Draw a line through these points. `number` selects the colour and the dashes of the line."""
    dash = DASHES[number % len(DASHES)]
    return Markup('<path class="line" d="M{}" stroke="{}" stroke-width="2" stroke-linejoin="round"{}/>').format(
        "L".join(f"{n(x)} {n(y)}" for x, y in points),
        COLOURS[number % len(COLOURS)],
        Markup(' stroke-dasharray="{}"').format(dash) if dash else "",
    )


def dot(x: float, y: float, number: int, tip: str) -> Markup:
    """Draw a dot with the tooltip `tip`."""
    return Markup(
        '<circle cx="{}" cy="{}" r="3" fill="{}" stroke="{}" stroke-width="2"><title>{}</title></circle>'
    ).format(n(x), n(y), GROUND, COLOURS[number % len(COLOURS)], tip)


def name(x: float, y: float, anchor: str, number: int, text: str) -> Markup:
    """Write the name of a line in the colour of this line."""
    return Markup('<text x="{}" y="{}" font-size="12" text-anchor="{}" fill="{}">{}</text>').format(
        n(x), n(y), anchor, COLOURS[number % len(COLOURS)], text
    )


def document(
    height: float, heading: str, about: str, description: str, panels: Iterable[Markup], foot: str, *, ids: str = ""
) -> str:
    """Return a complete SVG file, which needs no other files.

    `description` describes the picture in words. `ids` is a prefix that makes the IDs unique on a page with several
    pictures.
    """
    return str(
        Markup(
            '<svg xmlns="http://www.w3.org/2000/svg" class="chart" role="img" width="{w}" height="{h}"'
            ' viewBox="0 0 {w} {h}" aria-labelledby="{ids}title {ids}desc" font-family="{font}"'
            ' font-size="13" fill="none">'
            '<title id="{ids}title">{heading}</title><desc id="{ids}desc">{description}</desc><style>{style}</style>'
            '<rect class="ground" width="100%" height="100%" fill="{ground}"/>\n'
            '<text x="{x}" y="32" font-size="20" font-weight="600" fill="{ink}">{title}</text>'
            '<text class="quiet" x="{x}" y="54" fill="{quiet}">{about}</text>\n{panels}'
            '<text class="quiet" x="{x}" y="{foot_y}" font-size="12" fill="{quiet}">{foot}</text></svg>\n'
        ).format(
            w=WIDTH,
            h=height,
            ids=ids,
            font=FONT,
            heading=heading,
            description=description,
            style=STYLE,
            ground=GROUND,
            x=MARGIN + 4,
            ink=INK,
            quiet=QUIET,
            title=heading if len(heading) <= TITLE_LENGTH else heading[: TITLE_LENGTH - 1] + "\u2026",
            about=about,
            panels=Markup("").join(panels),
            foot_y=height - 14,
            foot=foot,
        )
    )


def filled(template: str, *values: object) -> Markup:
    """Insert values into a template and escape their text, except Markup. `Markup(template).format(*values)` gives the
    same result, but takes more than twice as long.
    """
    return Markup(template.format(*map(escape, values)))  # noqa: S704 - the values are escaped


def n(number: float) -> str:
    """Format a coordinate in pixels with one decimal."""
    return f"{number:.1f}".removesuffix(".0")


def _tick(x: float, y: float, anchor: str, text: str) -> Markup:
    return Markup('<text class="quiet" x="{}" y="{}" font-size="12" text-anchor="{}" fill="{}">{}</text>').format(
        n(x), n(y), anchor, QUIET, text
    )
