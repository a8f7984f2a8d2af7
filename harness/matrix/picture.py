"""matrix.svg: how the swarm fares as the loss grows, six small panels side by side over the same axis.

Lines are means, bands their 95 % intervals, a dot each loss that was measured. Colours stand in attributes, so that
programs without style sheets draw it too; `picture.css` adds the dark scheme. Two lines in a panel also differ by
their dashes and are named where they are.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from harness.matrix.cell import Cell
from harness.matrix.metrics import METRICS, Metric
from harness.matrix.record import MatrixRecord
from harness.matrix.table import say
from harness.report import words

STYLE = (Path(__file__).parent / "picture.css").read_text(encoding="utf-8")

WIDTH, MARGIN = 900, 16
COLUMNS = 3
HEAD, PANEL_HEIGHT, FOOT = 74, 218, 26
_LEFT, _RIGHT, _TOP, _BOTTOM = 48, 18, 34, 40  # of a panel, around its axes
_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', 'DejaVu Sans', sans-serif"
_INK, _QUIET, _RULE = "#1c2126", "#57616b", "#d9dee2"
_COLOURS = ("#0072b2", "#a83900")
_CLASSES = ("first", "second")
_DASHES = ("", "6 3")
_TITLE_LENGTH = 80

_BY_NAME = {metric.name: metric for metric in METRICS}


@dataclass(frozen=True, slots=True)
class Panel:
    """What one panel shows: metrics with the names of their lines."""

    title: str
    lines: tuple[tuple[str, str], ...]

    @property
    def shares(self) -> bool:
        return _BY_NAME[self.lines[0][0]].unit != "number"


PANELS = (
    Panel("Runs with one uniform chain", (("uniform", ""),)),
    Panel("Blocks in the mutual chain", (("mutual_share", ""),)),
    Panel("Distinct chains", (("distinct_chains", ""),)),
    Panel("Copies of a block", (("copies_mean", "mean"), ("copies_min", "fewest"))),
    Panel("Reconciles", (("reconciles", ""),)),
    Panel("Messages per block", (("messages_per_block", ""),)),
)


@dataclass(frozen=True, slots=True)
class Axis:
    """From values to a place in the picture."""

    first: float
    last: float
    start: float
    end: float
    ticks: Sequence[float]

    def __call__(self, value: float) -> float:
        inside = min(max(value, self.first), self.last)
        return self.start + (inside - self.first) / (self.last - self.first) * (self.end - self.start)


def draw(record: MatrixRecord) -> str:
    """A file of its own."""
    rows = math.ceil(len(PANELS) / COLUMNS)
    width = (WIDTH - 2 * MARGIN) / COLUMNS
    cells = sorted(record.cells, key=lambda cell: cell.loss)
    panels = [
        _panel(panel, cells, MARGIN + index % COLUMNS * width, HEAD + index // COLUMNS * PANEL_HEIGHT, width)
        for index, panel in enumerate(PANELS)
    ]
    height = HEAD + rows * PANEL_HEIGHT + FOOT
    name = record.matrix.name
    return str(
        Markup(
            '<svg xmlns="http://www.w3.org/2000/svg" class="matrix" role="img" width="{w}" height="{h}"'
            ' viewBox="0 0 {w} {h}" aria-labelledby="title desc" font-family="{font}" font-size="13" fill="none">'
            '<title id="title">{name}</title><desc id="desc">{description}</desc><style>{style}</style>'
            '<rect class="ground" width="100%" height="100%" fill="#ffffff"/>\n'
            '<text x="{x}" y="32" font-size="20" font-weight="600" fill="{ink}">{heading}</text>'
            '<text class="quiet" x="{x}" y="54" fill="{quiet}">{about}</text>\n{panels}'
            '<text class="quiet" x="{x}" y="{foot}" font-size="12" fill="{quiet}">{legend}</text></svg>\n'
        ).format(
            w=WIDTH,
            h=height,
            font=_FONT,
            name=name,
            description=description(cells),
            style=STYLE,
            x=MARGIN + 4,
            ink=_INK,
            quiet=_QUIET,
            heading=name if len(name) <= _TITLE_LENGTH else name[: _TITLE_LENGTH - 1] + "\u2026",
            about=_about(record),
            panels=Markup("").join(panels),
            foot=height - 14,
            legend=_legend(record),
        )
    )


def description(cells: Sequence[Cell]) -> str:
    """What the picture shows, in words."""
    if not cells:
        return "No run has ended."
    parts = []
    for panel in PANELS:
        for name, line in panel.lines:
            values = (f"{_say(name, cell)} at {words.percent(cell.loss)}" for cell in cells)
            parts.append(f"{panel.title}{f' ({line})' if line else ''}: {', '.join(values)}.")
    return " ".join(parts)


def _about(record: MatrixRecord) -> str:
    scenario = record.matrix.scenario
    parts = [
        f"{len(scenario.roster)} agents, {words.duration(scenario.duration_s)}",
        f"{words.value(record.runs)} simulated runs",
    ]
    if record.outcome == "interrupted":
        parts.append(f"interrupted: {words.value(record.runs_asked)} were asked for")
    return " \u00b7 ".join(parts)


def _legend(record: MatrixRecord) -> str:
    runs = max((cell.runs for cell in record.cells), default=0)
    if runs < 2:
        return "Over packet loss at each receiver. One run at each dot: no intervals."
    return f"Over packet loss at each receiver. Dots and lines: means of {runs} runs; bands: their 95 % intervals."


def _panel(panel: Panel, cells: Sequence[Cell], x: float, y: float, width: float) -> Markup:
    across = _loss_axis([cell.loss for cell in cells], x + _LEFT, x + width - _RIGHT)
    up = _value_axis(panel, cells, y + PANEL_HEIGHT - _BOTTOM, y + _TOP)
    parts = [
        Markup('<g class="panel"><text x="{}" y="{}" font-weight="600" fill="{}">{}</text>').format(
            _n(x + 4), _n(y + 16), _INK, panel.title
        )
    ]
    for tick in up.ticks:
        parts.append(
            Markup('<path class="{}" d="M{} {}H{}" stroke="{}"/>').format(
                "rule" if tick else "base",
                _n(across.start),
                _n(up(tick)),
                _n(across.end),
                _RULE if tick else _QUIET,
            )
        )
        text = f"{100 * tick:.0f}\u00a0%" if panel.shares else words.value(round(tick, 6))
        parts.append(_tick(across.start - 7, up(tick) + 4, "end", text))
    for tick in across.ticks:
        parts.append(
            Markup('<path class="base" d="M{} {}v4" stroke="{}"/>').format(_n(across(tick)), _n(up.start), _QUIET)
        )
        parts.append(_tick(across(tick), up.start + 18, "middle", words.percent(tick)))
    parts += [
        _line(number, name, label, cells, across, up) for number, (name, label) in enumerate(panel.lines) if cells
    ]
    return Markup("").join([*parts, Markup("</g>\n")])


def _line(number: int, name: str, label: str, cells: Sequence[Cell], across: Axis, up: Axis) -> Markup:
    """Band, line, dots with tooltips, and the line's name beside its middle."""
    known = [(cell, cell.estimates[name]) for cell in cells if cell.estimates[name].mean is not None]
    bounded = [(cell.loss, one.low, one.high) for cell, one in known if one.low is not None and one.high is not None]
    upper = [f"{_n(across(loss))} {_n(up(high))}" for loss, _, high in bounded]
    lower = [f"{_n(across(loss))} {_n(up(low))}" for loss, low, _ in bounded]
    points = [(across(cell.loss), up(one.mean or 0.0)) for cell, one in known]
    colour = _COLOURS[number]
    parts = []
    if bounded:
        parts.append(
            Markup('<path class="band" fill="{}" fill-opacity=".22" d="M{}Z"/>').format(
                colour, "L".join([*upper, *reversed(lower)])
            )
        )
    if points:
        parts.append(
            Markup('<path class="line" d="M{}" stroke="{}" stroke-width="2" stroke-linejoin="round"{}/>').format(
                "L".join(f"{_n(x)} {_n(y)}" for x, y in points),
                colour,
                Markup(' stroke-dasharray="{}"').format(_DASHES[number]) if _DASHES[number] else "",
            )
        )
    for (x, y), (cell, _) in zip(points, known, strict=True):
        parts.append(
            Markup(
                '<circle cx="{}" cy="{}" r="3" fill="#ffffff" stroke="{}" stroke-width="2"><title>{}</title></circle>'
            ).format(_n(x), _n(y), colour, f"{words.percent(cell.loss)} loss: {_say(name, cell)}")
        )
    if label and points:
        x, y = points[len(points) // 2]
        above = number == 0
        parts.append(
            Markup('<text x="{}" y="{}" font-size="12" text-anchor="{}" fill="{}">{}</text>').format(
                _n(x + (6 if above else -6)), _n(y + (-8 if above else 16)), "start" if above else "end", colour, label
            )
        )
    return Markup('<g class="{}">{}</g>').format(_CLASSES[number], Markup("").join(parts))


def _loss_axis(losses: Sequence[float], start: float, end: float) -> Axis:
    first, last = min(losses, default=0.0), max(losses, default=1.0)
    if first == last:
        first, last = max(0.0, first - 0.05), min(1.0, last + 0.05)
    step = _step(last - first, 5)
    ticks = [number * step for number in range(math.ceil(first / step - 1e-9), math.floor(last / step + 1e-9) + 1)]
    return Axis(first, last, start, end, ticks)


def _value_axis(panel: Panel, cells: Sequence[Cell], start: float, end: float) -> Axis:
    """From 0 to the next tick above all means, and above all intervals but for a sliver; shares to 100 %."""
    if panel.shares:
        return Axis(0.0, 1.0, start, end, [0.0, 0.25, 0.5, 0.75, 1.0])
    estimates = [cell.estimates[name] for name, _ in panel.lines for cell in cells]
    means = [one.mean for one in estimates if one.mean is not None]
    highest = max([1.0, *means, *(0.98 * one.high for one in estimates if one.high is not None)])
    step = _step(highest, 5)
    count = math.ceil(highest / step - 1e-9)
    return Axis(0.0, count * step, start, end, [number * step for number in range(count + 1)])


def _step(span: float, most: int) -> float:
    """The smallest of 1, 2, 2.5, 5, 10, ... that takes at most so many steps across the span."""
    unit: float = 10.0 ** math.floor(math.log10(span / most))
    return next(factor * unit for factor in (1, 2, 2.5, 5, 10) if factor * unit * most >= span * (1 - 1e-9))


def _tick(x: float, y: float, anchor: str, text: str) -> Markup:
    return Markup('<text class="quiet" x="{}" y="{}" font-size="12" text-anchor="{}" fill="{}">{}</text>').format(
        _n(x), _n(y), anchor, _QUIET, text
    )


def _say(name: str, cell: Cell) -> str:
    metric: Metric = _BY_NAME[name]
    return say(metric, cell.estimates[name])


def _n(number: float) -> str:
    return f"{number:.1f}".removesuffix(".0")
