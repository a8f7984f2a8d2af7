"""scale.svg: how cost grows, small panels on logarithmic axes, where a power law is a straight line.

A dot is the mean of a size, a line the law that was fitted to its runs, and beside it stands the exponent. Lines differ
by colour and dashes and are named where they are.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

from markupsafe import Markup

from harness.present import svg
from harness.present import text as words
from harness.present.svg import Area, Axis
from harness.sweep.scale._cell import Cell, Growth
from harness.sweep.scale._growth import Law
from harness.sweep.scale._metrics import BY_NAME
from harness.sweep.scale.record import ScaleRecord
from harness.sweep.scale.table import SYMBOLS, say, say_exponent, say_number

COLUMNS = 3
HEAD, PANEL_HEIGHT, FOOT = 96, 236, 26
MOST = 4
"""So many lines in a panel can be told apart: of more, these are drawn that are spread over all."""
TICK_WIDTH = 24.0


@dataclass(frozen=True, slots=True)
class Panel:
    title: str
    metric: str
    over: Literal["agents", "blocks"] = "agents"

    @property
    def shares(self) -> bool:
        return BY_NAME[self.metric].unit != "number"


PANELS = (
    Panel("Messages per block", "messages_per_block"),
    Panel("Messages", "messages"),
    Panel("Bytes", "bytes"),
    Panel("Reconciles per block", "reconciles_per_block"),
    Panel("Blocks per minute, longest chain", "committed_per_minute"),
    Panel("Runs with one uniform chain", "uniform"),
    Panel("Messages", "messages", "blocks"),
    Panel("Bytes", "bytes", "blocks"),
    Panel("Processor seconds, here", "processor_s"),
)


@dataclass(frozen=True, slots=True)
class Series:
    """A line: what is it of, and which of the panel's colours it has."""

    number: int
    name: str
    cells: list[Cell]
    law: Law | None


def draw(record: ScaleRecord) -> str:
    """A file of its own."""
    areas = svg.grid(len(PANELS), COLUMNS, HEAD, PANEL_HEIGHT)
    panels = [_panel(record, panel, area) for panel, area in zip(PANELS, areas, strict=True)]
    return svg.document(
        HEAD + math.ceil(len(PANELS) / COLUMNS) * PANEL_HEIGHT + FOOT,
        "How the cost of a uniform chain grows",
        _about(record),
        description(record),
        [_legend(record), *panels],
        _foot(record),
    )


def description(record: ScaleRecord) -> str:
    """What the picture shows, in words."""
    if not record.cells:
        return "No run has ended."
    parts = []
    for panel in PANELS:
        for line in _series(record, panel):
            values = (f"{_say(panel, cell)} at {_at(panel, cell)}" for cell in line.cells)
            power = f" (exponent {_exponent(line.law, panel)})" if line.law else ""
            parts.append(f"{_title(record, panel)}, {line.name}{power}: {', '.join(values)}.")
    return " ".join(parts)


def _about(record: ScaleRecord) -> str:
    scale = record.scale
    parts = [
        f"{_range(scale.agents)} agents",
        f"{_range(scale.minutes)} min of mission, {scale.settle_minutes:g} to settle",
        f"loss {', '.join(map(words.percent, scale.loss))}",
        f"{words.value(record.runs)} simulated runs",
    ]
    if record.outcome == "interrupted":
        parts.append(f"interrupted: {words.value(record.runs_asked)} were asked for")
    return " \u00b7 ".join(parts)


def _foot(record: ScaleRecord) -> str:
    runs = max((cell.runs for cell in record.cells), default=0)
    dots = f"means of {runs} runs" if runs > 1 else "one run each"
    return (
        f"Over N agents or B blocks. Dots: {dots}; lines: fitted power laws with their exponents. "
        "All but processor time is virtual."
    )


def _title(record: ScaleRecord, panel: Panel) -> str:
    at = f" at {words.percent(record.scale.loss[-1])} loss" if len(record.scale.loss) > 1 else ""
    return panel.title if panel.over == "agents" else f"{panel.title}, over blocks{at}"


def _legend(record: ScaleRecord) -> Markup:
    """The lines over agents."""
    parts = []
    x = svg.MARGIN + 4.0
    for line in _series(record, PANELS[0]):
        parts.append(
            Markup('<g class="series {}">{}{}</g>').format(
                svg.CLASSES[line.number],
                svg.line([(x, 77), (x + 26, 77)], line.number),
                svg.name(x + 32, 81, "start", line.number, line.name),
            )
        )
        x += 60 + 7 * len(line.name)
    return Markup("").join(parts)


def _series(record: ScaleRecord, panel: Panel) -> list[Series]:
    """Over agents a line has one loss and mission length; over blocks one number of agents, at the highest loss."""
    over_agents = panel.over == "agents"
    fixed, unit = ("minutes", "\u00a0min") if over_agents else ("agents", " agents")
    losses = record.scale.loss if over_agents else record.scale.loss[-1:]

    def line_of(item: Cell | Growth) -> tuple[float, float | None]:
        return item.loss, getattr(item, fixed)

    lines = [line for line in product(losses, getattr(record.scale, fixed)) if line in map(line_of, record.cells)]
    laws = {
        line_of(growth): growth.law
        for growth in (*record.growths, *record.machine_growths)
        if (growth.metric, growth.over, growth.load) == (panel.metric, (panel.over,), "any")
    }
    drawn = dict.fromkeys(round(at * (len(lines) - 1) / (MOST - 1)) for at in range(MOST)) if lines else ()
    return [
        Series(
            number,
            f"{f'{words.percent(lines[at][0])} loss, ' if len(losses) > 1 else ''}{lines[at][1]:g}{unit}",
            [cell for cell in record.cells if line_of(cell) == lines[at]],
            laws.get(lines[at]),
        )
        for number, at in enumerate(drawn)
    ]


def _panel(record: ScaleRecord, panel: Panel, area: Area) -> Markup:
    lines = _series(record, panel)
    across, up = _across(panel, lines, area), _up(panel, lines, area)
    frame = svg.frame(
        _title(record, panel),
        across,
        up,
        map(say_number, across.ticks),
        (f"{100 * tick:.0f}\u00a0%" if panel.shares else say_number(tick) for tick in up.ticks),
    )
    drawn = [_line(panel, line, across, up) for line in lines]
    exponents = [(line, line.law) for line in lines if line.law]
    for row, (line, law) in enumerate(reversed(exponents)):
        drawn.append(_power(panel, line, law, across.end - 4, up.start - 8 - 15 * row))
    return Markup('<g class="panel">{}{}</g>\n').format(frame, Markup("").join(drawn))


def _line(panel: Panel, line: Series, across: Axis, up: Axis) -> Markup:
    """The law with its exponent, or what joins the dots; and the dots, with tooltips."""
    points = [(x, y, cell) for cell in line.cells if (x := _x(panel, cell)) and (y := _y(panel, cell)) is not None]
    ends = _ends(panel, line) or [(x, y) for x, y, _ in points]
    parts = [svg.line([(across(x), up(y)) for x, y in ends], line.number)] if ends else []
    parts += [
        svg.dot(across(x), up(y), line.number, f"{_at(panel, cell)}, {line.name}: {_say(panel, cell)}")
        for x, y, cell in points
    ]
    return Markup('<g class="series {}">{}</g>').format(svg.CLASSES[line.number], Markup("").join(parts))


def _power(panel: Panel, line: Series, law: Law, x: float, y: float) -> Markup:
    """The exponent of a law, and of what if the legend does not say it, in the corner that growth leaves empty."""
    value, margin = _exponent(law, panel).split("\u00b1")
    text = Markup('{}{}<tspan dy="-4" font-size="10">{}</tspan><tspan dy="4" font-size="10"> \u00b1{}</tspan>').format(
        f"{line.name}: " if panel.over == "blocks" else "", SYMBOLS[panel.over], value, margin
    )
    return Markup('<g class="series {}">{}</g>').format(
        svg.CLASSES[line.number], svg.name(x, y, "end", line.number, text)
    )


def _ends(panel: Panel, line: Series) -> list[tuple[float, float]]:
    """Of the law's line, from dot to dot."""
    xs = [x for cell in line.cells if (x := _x(panel, cell)) and _y(panel, cell)]
    if not line.law or not xs:
        return []
    power = line.law.exponents[panel.over].value
    return [(x, line.law.factor * x**power) for x in (min(xs), max(xs))]


def _across(panel: Panel, lines: Sequence[Series], area: Area) -> Axis:
    """Over agents the ticks are their numbers, as far as there is room."""
    xs = sorted({x for line in lines for cell in line.cells if (x := _x(panel, cell))}) or [1.0, 10.0]
    if panel.over == "blocks":
        return svg.log_axis(xs[0], xs[-1], area.across)
    axis = Axis(xs[0] * 0.9, xs[-1] * 1.1, *area.across, (), log=True)
    ticks: list[float] = []
    for x in xs:
        if not ticks or axis(x) - axis(ticks[-1]) >= TICK_WIDTH:
            ticks.append(x)
    return replace(axis, ticks=ticks)


def _up(panel: Panel, lines: Sequence[Series], area: Area) -> Axis:
    if panel.shares:
        return svg.share_axis(area.up)
    ys = [y for line in lines for cell in line.cells if (y := _y(panel, cell))]
    ys += [y for line in lines for _, y in _ends(panel, line)]
    return svg.log_axis(min(ys, default=1.0), max(ys, default=10.0), area.up)


def _x(panel: Panel, cell: Cell) -> float | None:
    """None cannot be drawn on the axis."""
    return float(cell.agents) if panel.over == "agents" else cell.estimates["blocks"].mean or None


def _y(panel: Panel, cell: Cell) -> float | None:
    mean = {**cell.estimates, **cell.machine}[panel.metric].mean
    return mean if mean or panel.shares else None


def _at(panel: Panel, cell: Cell) -> str:
    return f"{say_number(_x(panel, cell) or 0.0)} {panel.over}"


def _say(panel: Panel, cell: Cell) -> str:
    return say(BY_NAME[panel.metric], {**cell.estimates, **cell.machine}[panel.metric])


def _exponent(law: Law, panel: Panel) -> str:
    return say_exponent(law.exponents[panel.over])


def _range(values: Sequence[float]) -> str:
    return f"{values[0]:g}" if len(values) == 1 else f"{values[0]:g}\u2013{values[-1]:g}"
