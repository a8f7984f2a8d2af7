"""Draw a numeric result over several nights, in a small chart for each loss rate, number of agents and backend.

Dots and lines are means, and bands are 95 % intervals. Each chart has its own scale, because the trend shows changes
and not absolute values. Each step to the right is one night.

The table of cells and nights shows whether each cell had violations or changes in each night.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from harness.present import svg, text
from harness.present.svg import Axis, ChartArea, n
from harness.sweep.matrix._cell import Cell
from harness.sweep.matrix._estimate import Estimate
from harness.sweep.matrix._matrix_file import MatrixPoint
from harness.sweep.matrix._matrix_picture import LinePoint, curve
from harness.sweep.matrix.matrix_record import MatrixRecord
from harness.sweep.matrix.matrix_table import name_of, say, series, series_name, violated
from harness.sweep.matrix.report._heatmap import HeatmapFigure

COLUMNS, PANEL_HEIGHT, FOOT = 4, 158, 4
MAX_DOTS = 12_000
"""Maximum number of dots on a page. If there are more, the page shows fewer nights."""
LARGEST = 1e12
"""Largest plausible value. Larger values in a file are ignored."""


def nights_drawn(nights: Sequence[MatrixRecord], tonight: MatrixRecord, figures: int) -> Sequence[MatrixRecord]:
    """Return the latest nights. Their number is limited so that all charts together have at most `MAX_DOTS` dots.

    At least two nights are returned, even if they exceed this limit.
    """
    return nights[-max(2, MAX_DOTS // max(1, len(tonight.cells) * figures)) :]


def trend(nights: Sequence[MatrixRecord], tonight: MatrixRecord, figure: HeatmapFigure) -> list[tuple[str, Markup]]:
    """Return a drawing with charts for each number of agents and each backend. If there are several drawings, each has
    a name.
    """
    of_night = [{cell.point: figure.of(cell) for cell in night.cells} for night in nights]
    begun = [text.started(night.started_at)[:16] for night in nights]
    commits = [f"commit {night.versions.get('commit', 'unknown')}" for night in nights]
    drawings = []
    for cells in series(tonight):
        cells = sorted(cells, key=lambda cell: cell.loss)
        areas = svg.grid(len(cells), COLUMNS, 0, PANEL_HEIGHT)
        panels = []
        for cell, area in zip(cells, areas, strict=True):
            known = [(at, by_point[cell.point]) for at, by_point in enumerate(of_night) if cell.point in by_point]
            dots = [
                LinePoint(at, estimate, f"{begun[at]}, {commits[at]}: {say(figure.metric, estimate)}")
                for at, estimate in known
                if _is_sane(estimate)
            ]
            panels.append(_panel(figure, cell, dots, [night.started_at[5:10] for night in nights], area))
        height = math.ceil(len(cells) / COLUMNS) * PANEL_HEIGHT + FOOT
        name = ", ".join(series_name(tonight.matrix, cells[0].point))
        drawings.append((name, _drawing(height, f"{figure.metric.label} over {len(nights)} nights", panels)))
    return drawings


def _drawing(height: float, label: str, panels: Sequence[Markup]) -> Markup:
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="chart" role="img" width="{w}" height="{h}"'
        ' viewBox="0 0 {w} {h}" aria-label="{label}" font-size="13" fill="none">{panels}</svg>'
    ).format(w=svg.WIDTH, h=n(height), label=label, panels=Markup("").join(panels))


def _panel(
    figure: HeatmapFigure, cell: Cell, dots: Sequence[LinePoint], dates: Sequence[str], area: ChartArea
) -> Markup:
    last = len(dates) - 1
    across = Axis(0, last, *area.across, sorted({0, last // 2, last} if last > 3 else {0, last}))
    up = _value_axis(figure, [dot.estimate for dot in dots], area)
    frame = svg.frame(
        f"{text.percent(cell.loss)} loss",
        across,
        up,
        (dates[int(tick)] for tick in across.ticks),
        (text.value(round(tick, 6)) if figure.metric.unit == "number" else text.percent(tick) for tick in up.ticks),
    )
    drawing, _ = curve(0, dots, across, up)
    return Markup('<g class="panel">{}<g class="series {}">{}</g></g>\n').format(frame, svg.CLASSES[0], drawing)


def _value_axis(figure: HeatmapFigure, estimates: Sequence[Estimate], area: ChartArea) -> Axis:
    """Return a vertical axis that covers all confidence intervals. The axis has a minimum length, so that small changes
    look small.
    """
    bounds = [
        bound for estimate in estimates for bound in (estimate.low, estimate.mean, estimate.high) if bound is not None
    ]
    low, high = min(bounds, default=0.0), max(bounds, default=1.0)
    least = 0.04 if figure.metric.unit != "number" else max(0.2, 0.1 * abs(high))
    margin = max(0.0, least - (high - low)) / 2
    low, high = low - margin, high + margin
    every = svg.step(high - low, 3)
    first, last = math.floor(low / every + 1e-9) * every, math.ceil(high / every - 1e-9) * every
    ceiling = 1.0 if figure.metric.unit != "number" else last
    ticks = [number * every for number in range(round(first / every), round(last / every) + 1)]
    first, last = max(0.0, first), min(ceiling, last)
    return Axis(first, last, *area.up, [tick for tick in ticks if first <= tick <= last])


def _is_sane(estimate: Estimate) -> bool:
    return all(abs(bound) < LARGEST for bound in (estimate.low, estimate.mean, estimate.high) if bound is not None)


@dataclass(frozen=True, slots=True)
class NightColumn:
    """The heading of a table column about one night: the date of the night, and the commit of the code."""

    date: str
    commit: str
    started: str


@dataclass(frozen=True, slots=True)
class NightCell:
    """The state of a cell in one night: a short sign, all facts as text, and a CSS class."""

    sign: str
    in_words: str
    kind: str


def night_columns(nights: Sequence[MatrixRecord]) -> list[NightColumn]:
    return [
        NightColumn(night.started_at[5:10], night.versions.get("commit", "unknown"), text.started(night.started_at))
        for night in nights
    ]


def night_rows(nights: Sequence[MatrixRecord], tonight: MatrixRecord) -> list[tuple[str, list[NightCell]]]:
    """Return the name of each cell in the matrix of this night, with one table field for each night."""
    return [
        (name_of(tonight.matrix, point), [_night_cell(night, point) for night in nights])
        for point in tonight.matrix.points
    ]


def _night_cell(night: MatrixRecord, point: MatrixPoint) -> NightCell:
    cell = next((cell for cell in night.cells if cell.point == point), None)
    if cell is None:
        return NightCell("", "no runs", "unknown")
    bad = violated(cell) + cell.failed
    against = night.against
    worse = sum(change.point == point for change in against.regressions) if against else 0
    changed = sum(len(each.seeds) for each in against.changed_runs if each.point == point) if against else 0
    facts = [
        (bad, "✗", f"{bad} with a violation or failure", "violated"),
        (worse, "▼", f"{worse} figure{'s' if worse > 1 else ''} worse than in the baseline", "violated"),
        (changed, "△", f"{changed} changed run{'s' if changed > 1 else ''}", "unknown"),
    ]
    found = [(f"{sign}{count}", meaning, kind) for count, sign, meaning, kind in facts if count]
    if not found:
        return NightCell("✓", f"{cell.runs} runs, no violation", "holds")
    signs, meanings = (" ".join(sign for sign, _, _ in found), ", ".join(meaning for _, meaning, _ in found))
    return NightCell(signs, f"{cell.runs} runs: {meanings}", found[0][2])
