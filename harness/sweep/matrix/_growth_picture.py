"""Draw growth.svg: small charts with logarithmic axes, on which a power law is a straight line.

A dot is the mean of a cell. A line is a power law that is fitted to the runs of these cells, with its exponent beside
it. Lines differ in colour and dashes. If the horizontal axis shows agents, the legend names the lines. If it shows
blocks, the text of each exponent names the line.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from markupsafe import Markup

from harness.backend_names import BackendName
from harness.present import svg
from harness.present import text as words
from harness.present.svg import Axis, ChartArea
from harness.sweep.matrix._cell import Cell
from harness.sweep.matrix._estimate import GROWTH_BY_NAME, Estimate
from harness.sweep.matrix._growth import Growth, Law, Variable
from harness.sweep.matrix._growth_table import SYMBOLS, say, say_exponent, say_number
from harness.sweep.matrix._matrix_file import Matrix
from harness.sweep.matrix.matrix_record import MatrixRecord

COLUMNS = 3
HEAD, PANEL_HEIGHT, FOOT = 96, 236, 26
MAX_LINES = 4
"""Maximum number of lines in a chart. If there are more lines, the chart shows a selection of them at even
distances.
"""
TICK_WIDTH = 24.0


@dataclass(frozen=True, slots=True)
class GrowthPanel:
    title: str
    metric: str
    over: Variable = "agents"

    @property
    def shares(self) -> bool:
        return GROWTH_BY_NAME[self.metric].unit != "number"


PANELS = (
    GrowthPanel("Messages per block", "messages_per_block"),
    GrowthPanel("Messages", "messages"),
    GrowthPanel("Bytes", "bytes"),
    GrowthPanel("Messages per minute", "messages_per_minute"),
    GrowthPanel("Reconciles per block", "reconciles_per_block"),
    GrowthPanel("Blocks per minute, longest chain", "committed_per_minute"),
    GrowthPanel("Runs with one uniform chain", "uniform"),
)
ALSO_OVER_BLOCKS = ("messages", "bytes")
"""Metrics with a second chart, whose horizontal axis shows the number of blocks. This chart needs a matrix with three
numbers of agents and three mission lengths.
"""


@dataclass(frozen=True, slots=True)
class ChartLineKey:
    """The values that all points of a line in a chart have in common. The value that changes along the line is None."""

    backend: BackendName
    loss: float
    agents: int | None
    duration_s: float | None


@dataclass(frozen=True, slots=True)
class PanelLine:
    """A line of a chart. The line has a number, which determines its colour."""

    number: int
    name: str
    cells: list[Cell]
    law: Law | None


def draw_growth(record: MatrixRecord) -> str:
    """Return the picture as an SVG file."""
    panels = panels_of(record.matrix)
    areas = svg.grid(len(panels), COLUMNS, HEAD, PANEL_HEIGHT)
    drawn = [_panel(record, panel, area) for panel, area in zip(panels, areas, strict=True)]
    return svg.document(
        HEAD + math.ceil(len(panels) / COLUMNS) * PANEL_HEIGHT + FOOT,
        record.matrix.name,
        _subtitle(record),
        description(record),
        [_legend(record), *drawn],
        _footnote(record),
        ids="growth-",
    )


def panels_of(matrix: Matrix) -> list[GrowthPanel]:
    over_agents = [*PANELS] if matrix.grows_with_agents else []
    also = [panel for panel in PANELS if not over_agents or panel.metric in ALSO_OVER_BLOCKS]
    return over_agents + ([replace(panel, over="blocks") for panel in also] if matrix.grows_with_length else [])


def description(record: MatrixRecord) -> str:
    """Return a text that describes the picture."""
    if not record.cells:
        return "No run has ended."
    parts = []
    for panel in panels_of(record.matrix):
        for line in _lines(record, panel):
            values = (f"{_value_text(panel, cell)} at {_at(panel, cell)}" for cell in line.cells)
            about = ", ".join(filter(None, (_title(record, panel), line.name)))
            power = f" (exponent {say_exponent(line.law.exponents[panel.over])})" if line.law else ""
            parts.append(f"{about}{power}: {', '.join(values)}.")
    return " ".join(parts)


def _subtitle(record: MatrixRecord) -> str:
    matrix = record.matrix
    agents = [point.agents for point in matrix.points]
    parts = [
        f"{_range(agents)} agents",
        f"{_range(matrix.lengths)} s of mission, {matrix.scenario.settle.limit_s:g} s to settle",
        f"loss {', '.join(map(words.percent, matrix.loss))}",
        f"{words.value(record.runs)} runs",
    ]
    if record.outcome == "interrupted":
        parts.append(f"interrupted: {words.value(record.runs_asked)} were asked for")
    return " \u00b7 ".join(parts)


def _footnote(record: MatrixRecord) -> str:
    runs = max((cell.runs for cell in record.cells), default=0)
    dots = f"means of {runs} runs" if runs > 1 else "one run each"
    return f"Over N agents or B blocks. Dots: {dots}; lines: fitted power laws with their exponents."


def _title(record: MatrixRecord, panel: GrowthPanel) -> str:
    if panel.over == "agents":
        return panel.title
    one_loss = record.matrix.grows_with_agents and len(record.matrix.loss) > 1
    return f"{panel.title}, over blocks" + (f" at {words.percent(max(record.matrix.loss))} loss" if one_loss else "")


def _legend(record: MatrixRecord) -> Markup:
    """Draw the legend, which contains the names of all lines."""
    parts = []
    x = svg.MARGIN + 4.0
    for line in _lines(record, panels_of(record.matrix)[0]):
        if line.name:
            parts.append(
                Markup('<g class="series {}">{}{}</g>').format(
                    svg.CLASSES[line.number],
                    svg.line([(x, 77), (x + 26, 77)], line.number),
                    svg.name(x + 32, 81, "start", line.number, line.name),
                )
            )
            x += 60 + 7 * len(line.name)
    return Markup("").join(parts)


def _lines(record: MatrixRecord, panel: GrowthPanel) -> list[PanelLine]:
    """Return the lines of a chart.

    A line over agents has one mission length, and a line over blocks has one number of agents. If the chart has lines
    over agents, lines over blocks are drawn only for the highest loss rate.
    """
    matrix, over_agents = record.matrix, panel.over == "agents"
    losses = matrix.loss if over_agents or not matrix.grows_with_agents else [max(matrix.loss)]
    by_place: dict[ChartLineKey, list[Cell]] = {}
    for cell in record.cells:
        if cell.loss in losses:
            by_place.setdefault(_place_of(cell, panel), []).append(cell)
    laws = {
        _place_of(growth, panel): growth.law
        for growth in record.growths
        if (growth.metric, growth.over, growth.load) == (panel.metric, (panel.over,), "any")
    }
    places = [*by_place]
    chosen = dict.fromkeys(round(at * (len(places) - 1) / (MAX_LINES - 1)) for at in range(MAX_LINES)) if places else ()
    return [
        PanelLine(
            number,
            _name(matrix, losses, places[at]),
            sorted(by_place[places[at]], key=lambda cell: (cell.agents, cell.duration_s or 0.0)),
            laws.get(places[at]),
        )
        for number, at in enumerate(chosen)
    ]


def _place_of(item: Cell | Growth, panel: GrowthPanel) -> ChartLineKey:
    along = panel.over == "agents"
    return ChartLineKey(item.backend, item.loss, None if along else item.agents, item.duration_s if along else None)


def _name(matrix: Matrix, losses: Sequence[float], place: ChartLineKey) -> str:
    """Return the name of a line. The name contains the values, such as the loss rate, by which the line differs from
    the other lines.
    """
    return ", ".join(
        [
            *([f"{words.percent(place.loss)} loss"] if len(losses) > 1 else []),
            *([f"{place.agents} agents"] if place.agents is not None and len(matrix.agents or ()) > 1 else []),
            *([words.duration(place.duration_s)] if place.duration_s is not None and len(matrix.lengths) > 1 else []),
            *([place.backend] if len(matrix.backend) > 1 else []),
        ]
    )


def _panel(record: MatrixRecord, panel: GrowthPanel, area: ChartArea) -> Markup:
    lines = _lines(record, panel)
    across, up = _across(panel, lines, area), _vertical_axis(panel, lines, area)
    frame = svg.frame(
        _title(record, panel),
        across,
        up,
        map(say_number, across.ticks),
        (f"{100 * tick:.0f}\u00a0%" if panel.shares else say_number(tick) for tick in up.ticks),
    )
    drawn = [_line(panel, line, across, up) for line in lines]
    named = record.matrix.grows_with_agents and panel.over == "blocks"
    exponents = [(line, line.law) for line in lines if line.law]
    for row, (line, law) in enumerate(reversed(exponents)):
        prefix = f"{line.name}: " if named and line.name else ""
        drawn.append(_power(panel, line, law, prefix, across.end - 4, up.start - 8 - 15 * row))
    return Markup('<g class="panel">{}{}</g>\n').format(frame, Markup("").join(drawn))


def _line(panel: GrowthPanel, line: PanelLine, across: Axis, up: Axis) -> Markup:
    """Draw the points of a line, and the power law that fits them. The points have tooltips. If no power law was
    fitted, connect the points by straight lines.
    """
    points = [(x, y, cell) for cell in line.cells if (x := _x(panel, cell)) and (y := _y(panel, cell)) is not None]
    ends = _ends(panel, line) or [(x, y) for x, y, _ in points]
    parts = [svg.line([(across(x), up(y)) for x, y in ends], line.number)] if ends else []
    for x, y, cell in points:
        about = ", ".join(filter(None, (_at(panel, cell), line.name)))
        parts.append(svg.dot(across(x), up(y), line.number, f"{about}: {_value_text(panel, cell)}"))
    return Markup('<g class="series {}">{}</g>').format(svg.CLASSES[line.number], Markup("").join(parts))


def _power(panel: GrowthPanel, line: PanelLine, law: Law, prefix: str, x: float, y: float) -> Markup:
    """Write the exponent of a power law into an empty corner of the chart."""
    value, margin = say_exponent(law.exponents[panel.over]).split("\u00b1")
    text = Markup('{}{}<tspan dy="-4" font-size="10">{}</tspan><tspan dy="4" font-size="10"> \u00b1{}</tspan>').format(
        prefix, SYMBOLS[panel.over], value, margin
    )
    return Markup('<g class="series {}">{}</g>').format(
        svg.CLASSES[line.number], svg.name(x, y, "end", line.number, text)
    )


def _ends(panel: GrowthPanel, line: PanelLine) -> list[tuple[float, float]]:
    """Return the two end points of the line that represents a power law. They are at the first and the last point of
    the data.
    """
    xs = [x for cell in line.cells if (x := _x(panel, cell)) and _y(panel, cell)]
    if not line.law or not xs:
        return []
    power = line.law.exponents[panel.over].value
    return [(x, line.law.factor * x**power) for x in (min(xs), max(xs))]


def _across(panel: GrowthPanel, lines: Sequence[PanelLine], area: ChartArea) -> Axis:
    """Return the horizontal axis of a chart. If the axis shows numbers of agents and has enough space, each number of
    agents gets a tick.
    """
    xs = sorted({x for line in lines for cell in line.cells if (x := _x(panel, cell))}) or [1.0, 10.0]
    if panel.over == "blocks":
        return svg.log_axis(xs[0], xs[-1], area.across)
    axis = Axis(xs[0] * 0.9, xs[-1] * 1.1, *area.across, (), log=True)
    ticks: list[float] = []
    for x in xs:
        if not ticks or axis(x) - axis(ticks[-1]) >= TICK_WIDTH:
            ticks.append(x)
    return replace(axis, ticks=ticks)


def _vertical_axis(panel: GrowthPanel, lines: Sequence[PanelLine], area: ChartArea) -> Axis:
    if panel.shares:
        return svg.share_axis(area.up)
    ys = [y for line in lines for cell in line.cells if (y := _y(panel, cell))]
    ys += [y for line in lines for _, y in _ends(panel, line)]
    return svg.log_axis(min(ys, default=1.0), max(ys, default=10.0), area.up)


def _x(panel: GrowthPanel, cell: Cell) -> float | None:
    """Return the value that a cell has on the horizontal axis. Return None if a logarithmic axis cannot show
    the value.
    """
    return float(cell.agents) if panel.over == "agents" else _mean("blocks", cell) or None


def _y(panel: GrowthPanel, cell: Cell) -> float | None:
    mean = _mean(panel.metric, cell)
    return mean if mean or panel.shares else None


def _mean(metric: str, cell: Cell) -> float | None:
    return cell.estimates[metric].mean if metric in cell.estimates else None


def _at(panel: GrowthPanel, cell: Cell) -> str:
    return f"{say_number(_x(panel, cell) or 0.0)} {panel.over}"


def _value_text(panel: GrowthPanel, cell: Cell) -> str:
    return say(GROWTH_BY_NAME[panel.metric], cell.estimates.get(panel.metric, Estimate(n=0)))


def _range(values: Sequence[float]) -> str:
    first, last = min(values), max(values)
    return f"{first:g}" if first == last else f"{first:g}\u2013{last:g}"
