"""Draw matrix.svg: six charts side by side, with the loss rate as horizontal axis.

There is a row of six charts for each number of agents, mission length and backend. Lines are means, bands are 95 %
intervals, and dots mark the loss rates that were measured. If a chart has two lines, they also have different dashes,
and a name is next to each line.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from harness.play.backends import in_virtual_time
from harness.present import svg, text
from harness.present.svg import Axis, ChartArea, n
from harness.sweep.matrix._cell import Cell
from harness.sweep.matrix._estimate import BY_NAME, Estimate
from harness.sweep.matrix.matrix_record import MatrixRecord
from harness.sweep.matrix.matrix_table import say, say_lengths, series, series_name

COLUMNS = 3
HEAD, SERIES_HEAD, PANEL_HEIGHT, FOOT = 74, 26, 218, 26


@dataclass(frozen=True, slots=True)
class ChartPanel:
    """The contents of a chart: several numeric results, with a name for the line of each."""

    title: str
    lines: tuple[tuple[str, str], ...]

    @property
    def shares(self) -> bool:
        return BY_NAME[self.lines[0][0]].unit != "number"


PANELS = (
    ChartPanel("Runs with one uniform chain", (("uniform", ""),)),
    ChartPanel("Blocks in the mutual chain", (("mutual_share", ""),)),
    ChartPanel("Distinct chains", (("distinct_chains", ""),)),
    ChartPanel("Copies of a block", (("copies_mean", "mean"), ("copies_min", "fewest"))),
    ChartPanel("Reconciles", (("reconciles", ""),)),
    ChartPanel("Messages per block", (("messages_per_block", ""),)),
)


@dataclass(frozen=True, slots=True)
class LinePoint:
    """A point of a line: an estimate with its horizontal position and its tooltip."""

    x: float
    estimate: Estimate
    tip: str


@dataclass(frozen=True, slots=True)
class PlacedPanel:
    """A chart, with its ID in the SVG file and its area in the picture."""

    id: str
    panel: ChartPanel
    area: ChartArea


@dataclass(frozen=True, slots=True)
class PanelRow:
    """A row of charts with a title above it. `name` is the title, or empty if the picture has only one row."""

    name: str
    cells: list[Cell]
    top: float
    panels: list[PlacedPanel]


def series_of(record: MatrixRecord) -> list[PanelRow]:
    """Return the rows of the picture from top to bottom."""
    top: float = HEAD
    made = []
    for number, cells in enumerate(_series(record)):
        name, begins = _name(record, cells), top
        top += SERIES_HEAD if name else 0
        areas = svg.grid(len(PANELS), COLUMNS, top, PANEL_HEIGHT)
        panels = [PlacedPanel(f"panel-{number}-{at}", panel, areas[at]) for at, panel in enumerate(PANELS)]
        made.append(PanelRow(name, cells, begins, panels))
        top += math.ceil(len(PANELS) / COLUMNS) * PANEL_HEIGHT
    return made


def draw(record: MatrixRecord) -> str:
    """Return the picture as an SVG file."""
    rows = series_of(record)
    parts = []
    for row in rows:
        parts += [_heading(row.name, row.top)] if row.name else []
        parts += [_panel(placed, row.cells) for placed in row.panels]
    last = rows[-1].panels[-1].area
    bottom = last.y + last.height + FOOT
    return svg.document(bottom, record.matrix.name, _subtitle(record), description(record), parts, _legend(record))


def _heading(name: str, top: float) -> Markup:
    return Markup('<text x="{}" y="{}" font-size="15" font-weight="600" fill="{}">{}</text>\n').format(
        n(svg.MARGIN + 4), n(top + 12), svg.INK, name
    )


def _series(record: MatrixRecord) -> list[list[Cell]]:
    """Return the results for the rows of the picture. Each row is sorted by loss rate. If no run has ended, return one
    empty row.
    """
    return [sorted(cells, key=lambda cell: cell.loss) for cells in series(record)] or [[]]


def _name(record: MatrixRecord, cells: Sequence[Cell]) -> str:
    """Return the title of a row of charts. The title contains the values by which the row differs from the
    other rows.
    """
    return ", ".join(series_name(record.matrix, cells[0].point)) if cells else ""


def description(record: MatrixRecord) -> str:
    """Return a text that describes the picture of the matrix."""
    if not record.cells:
        return "No run has ended."
    parts = []
    for cells in _series(record):
        if series_is := _name(record, cells):
            parts.append(f"{series_is}:")
        for panel in PANELS:
            for name, line in panel.lines:
                values = (f"{_value_text(name, cell)} at {text.percent(cell.loss)}" for cell in cells)
                parts.append(f"{panel.title}{f' ({line})' if line else ''}: {', '.join(values)}.")
    return " ".join(parts)


def _subtitle(record: MatrixRecord) -> str:
    agents = sorted({point.agents for point in record.matrix.points})
    simulated = "simulated " if in_virtual_time(record.backend) else ""
    parts = [
        f"{', '.join(map(str, agents))} agents, {say_lengths(record.matrix)}",
        f"{text.value(record.runs)} {simulated}runs",
    ]
    if record.outcome == "interrupted":
        parts.append(f"interrupted: {text.value(record.runs_asked)} were asked for")
    return " \u00b7 ".join(parts)


def _legend(record: MatrixRecord) -> str:
    runs = max((cell.runs for cell in record.cells), default=0)
    if runs < 2:
        return "Over packet loss at each receiver. One run at each dot: no intervals."
    return f"Over packet loss at each receiver. Dots and lines: means of {runs} runs; bands: their 95 % intervals."


def _panel(placed: PlacedPanel, cells: Sequence[Cell]) -> Markup:
    panel, area = placed.panel, placed.area
    across, up = _loss_axis([cell.loss for cell in cells], area), _value_axis(panel, cells, area)
    frame = svg.frame(
        panel.title,
        across,
        up,
        (text.percent(tick) for tick in across.ticks),
        (f"{100 * tick:.0f}\u00a0%" if panel.shares else text.value(round(tick, 6)) for tick in up.ticks),
    )
    lines = [_line(number, name, label, cells, across, up) for number, (name, label) in enumerate(panel.lines) if cells]
    return Markup('<g class="panel" id="{}">{}{}</g>\n').format(placed.id, frame, Markup("").join(lines))


def _line(number: int, name: str, label: str, cells: Sequence[Cell], across: Axis, up: Axis) -> Markup:
    """Draw a line, and write its name next to its middle."""
    known = [
        LinePoint(cell.loss, cell.estimates[name], f"{text.percent(cell.loss)} loss: {_value_text(name, cell)}")
        for cell in cells
    ]
    drawing, points = curve(number, known, across, up)
    if label and points:
        x, y = points[len(points) // 2]
        above = number == 0
        place = (x + 6, y - 8, "start") if above else (x - 6, y + 16, "end")
        drawing += svg.name(*place, number, label)
    return Markup('<g class="series {}">{}</g>').format(svg.CLASSES[number], drawing)


def curve(number: int, dots: Sequence[LinePoint], across: Axis, up: Axis) -> tuple[Markup, list[tuple[float, float]]]:
    """Draw the line `number` of a chart with its band of confidence intervals. Return the drawing and the points. The
    line has no points for unknown means.
    """
    known = [dot for dot in dots if dot.estimate.mean is not None]
    bounded = [(dot.x, dot.estimate.low, dot.estimate.high) for dot in known]
    upper = [f"{n(across(x))} {n(up(high))}" for x, _, high in bounded if high is not None]
    lower = [f"{n(across(x))} {n(up(low))}" for x, low, _ in bounded if low is not None]
    points = [(across(dot.x), up(dot.estimate.mean or 0.0)) for dot in known]
    parts = []
    if upper:
        parts.append(
            Markup('<path class="band" fill="{}" fill-opacity=".22" d="M{}Z"/>').format(
                svg.COLOURS[number], "L".join([*upper, *reversed(lower)])
            )
        )
    if points:
        parts.append(svg.line(points, number))
    parts += [svg.dot(x, y, number, dot.tip) for (x, y), dot in zip(points, known, strict=True)]
    return Markup("").join(parts), points


def _loss_axis(losses: Sequence[float], area: ChartArea) -> Axis:
    first, last = min(losses, default=0.0), max(losses, default=1.0)
    if first == last:
        first, last = max(0.0, first - 0.05), min(1.0, last + 0.05)
    return svg.linear_axis(first, last, area.across)


def _value_axis(panel: ChartPanel, cells: Sequence[Cell], area: ChartArea) -> Axis:
    """Return a vertical axis from 0 to the first tick above all means and nearly all confidence intervals."""
    if panel.shares:
        return svg.share_axis(area.up)
    estimates = [cell.estimates[name] for name, _ in panel.lines for cell in cells]
    means = [estimate.mean for estimate in estimates if estimate.mean is not None]
    highest = max([1.0, *means, *(0.98 * estimate.high for estimate in estimates if estimate.high is not None)])
    step = svg.step(highest, 5)
    return svg.linear_axis(0.0, math.ceil(highest / step - 1e-9) * step, area.up)


def _value_text(name: str, cell: Cell) -> str:
    return say(BY_NAME[name], cell.estimates[name])
