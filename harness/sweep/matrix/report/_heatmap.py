"""Draw heatmaps of numeric results over the values of a matrix, and the menu from which a reader chooses a numeric
result.

Larger values have darker or lighter shades of one hue, which can be distinguished with any colour vision. Each cell
also shows its value. Violations, failures and changes have a sign and a text.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from harness.present import text as words
from harness.present.colours import ramp
from harness.sweep.matrix._cell import Cell
from harness.sweep.matrix._estimate import BEFORE_FINAL_RECONCILE, METRICS, Estimate, Metric, estimate_share, figure
from harness.sweep.matrix._matrix_file import MatrixPoint
from harness.sweep.matrix.matrix_record import MatrixRecord
from harness.sweep.matrix.matrix_table import name_of, say, say_interval, say_mean, violated

MEANINGS = {
    "uniform": "Share of the runs that end with the same chain on all agents.",
    "mutual_share": "Share of a run\u2019s blocks that are in the common part of all chains at the end.",
    "distinct_chains": "Number of different chains at the end.",
    "reconciles": "Number of reconciles of all agents.",
    "copies_mean": "Number of chains that contain a block at the end, mean over all blocks.",
    "copies_min": "Number of chains that contain the rarest block at the end.",
    "messages_per_block": "Number of messages that all agents sent, for each block.",
    "uniform_before_final_reconcile": "Share of the runs with the same chain on all agents before the final reconcile.",
    "mutual_share_before_final_reconcile": (
        "Share of a run\u2019s blocks that are in the common part of all chains before the final reconcile."
    ),
    "finished": "Share of the runs whose agents became idle after the last event.",
    "violated": "Share of the runs that violated a characteristic or failed a check of steps, records or liveness.",
}
_FINISHED = Metric("finished", "finished", figure("finished"), "share of runs")
_VIOLATED = Metric("violated", "violated", figure("violated"), "share of runs")


@dataclass(frozen=True, slots=True)
class HeatmapFigure:
    metric: Metric

    @property
    def meaning(self) -> str:
        return MEANINGS[self.metric.name]

    def of(self, cell: Cell) -> Estimate:
        if self.metric is _VIOLATED:
            return estimate_share(violated(cell), cell.runs - cell.failed - cell.unsupported)
        if self.metric is _FINISHED:
            return cell.finished
        return cell.estimates.get(self.metric.name, Estimate(n=0))


def known_figures(cells: Iterable[Cell]) -> list[HeatmapFigure]:
    """Return the numeric results that are known for at least one run. The results before the final reconcile come
    first. The entry "violated" is always included.
    """
    cells = list(cells)
    names = {name for cell in cells for name, estimate in cell.estimates.items() if estimate.n}
    metrics = [metric for metric in BEFORE_FINAL_RECONCILE + METRICS if metric.name in names]
    judged = [_FINISHED] if any(cell.finished.n for cell in cells) else []
    return [HeatmapFigure(metric) for metric in (*metrics, *judged, _VIOLATED)]


SHADES = 11
_LIGHT = ramp((236, 244, 250), (0, 78, 122), SHADES)
_DARK = ramp((30, 41, 50), (120, 200, 245), SHADES)


def _style(inks: list[tuple[int, str, str]]) -> str:
    return "".join(f".shade-{step}{{background:{fill};color:{text}}}\n" for step, fill, text in inks)


STYLE = (
    _style([(step, ink.fill, ink.text) for step, ink in enumerate(_LIGHT)])
    + "@media screen and (prefers-color-scheme: dark) {\n"
    + _style([(step, ink.fill, ink.text) for step, ink in enumerate(_DARK)])
    + "}\n"
)


@dataclass(frozen=True, slots=True)
class TileMark:
    """A short note in a cell of the heatmap. `kind` is "bad" or "good", and determines the style of the note."""

    sign: str
    text: str
    kind: str


@dataclass(frozen=True, slots=True)
class HeatmapTile:
    """A field of the heatmap. `shade` is None if the value is unknown. `href` is None if there are no runs."""

    shade: int | None
    mean: str
    interval: str
    marks: list[TileMark]
    in_words: str
    href: str | None


@dataclass(frozen=True, slots=True)
class HeatmapGrid:
    """The fields of the heatmap for one backend and one mission length. Each row shows one number of agents, and each
    column shows one loss rate.
    """

    name: str
    losses: list[str]
    rows: list[tuple[str, list[HeatmapTile]]]


@dataclass(frozen=True, slots=True)
class Heatmap:
    """A heatmap. `lowest` is the value with the first shade, and `highest` is the value with the last shade."""

    figure: HeatmapFigure
    lowest: str
    highest: str
    grids: list[HeatmapGrid]


def anchor(point: MatrixPoint) -> str:
    """Return the HTML ID of the section that lists the runs with a combination of values."""
    return f"{point.file_name}-{point.backend}"


def heatmap(record: MatrixRecord, figure: HeatmapFigure) -> Heatmap:
    cells = {cell.point: cell for cell in record.cells}
    scale = _scale(figure, record)
    points = record.matrix.points
    grids = []
    agents = list(dict.fromkeys(point.agents for point in points))
    for backend, duration_s in dict.fromkeys((point.backend, point.duration_s) for point in points):
        rows = []
        for number in agents:
            its_points = [MatrixPoint(loss, number, backend, duration_s) for loss in record.matrix.loss]
            tiles = [_tile(record, figure, point, cells.get(point), scale) for point in its_points]
            rows.append((f"{number} agents" if number > 1 else "1 agent", tiles))
        name = backend if duration_s is None else f"{backend}, {words.duration(duration_s)}"
        grids.append(HeatmapGrid(name, [words.percent(loss) for loss in record.matrix.loss], rows))
    lowest, highest = (say_mean(figure.metric, Estimate(n=1, mean=bound)) for bound in scale)
    return Heatmap(figure, lowest, highest, grids)


def _scale(figure: HeatmapFigure, record: MatrixRecord) -> tuple[float, float]:
    """Return the two values that the first and the last shade stand for. They are 0 and 1 if the numeric result is a
    share. Otherwise, they are the smallest and the largest mean.
    """
    if figure.metric.unit != "number":
        return 0.0, 1.0
    means = [mean for cell in record.cells if (mean := figure.of(cell).mean) is not None]
    return min(means, default=0.0), max(means, default=0.0)


def _tile(
    record: MatrixRecord, figure: HeatmapFigure, point: MatrixPoint, cell: Cell | None, scale: tuple[float, float]
) -> HeatmapTile:
    name = name_of(record.matrix, point)
    if cell is None:
        return HeatmapTile(None, "\u2013", "", [], f"{name}: no run has ended", None)
    estimate, marks = figure.of(cell), _marks(record, figure, cell)
    text = ", ".join([say(figure.metric, estimate), *(mark.text for mark in marks)])
    return HeatmapTile(
        None if estimate.mean is None else _shade(estimate.mean, *scale),
        say_mean(figure.metric, estimate),
        say_interval(figure.metric, estimate),
        marks,
        f"{name}: {figure.metric.label} {text}",
        f"#{anchor(point)}",
    )


def _shade(mean: float, lowest: float, highest: float) -> int:
    return round((SHADES - 1) * (mean - lowest) / (highest - lowest)) if highest > lowest else 0


def _marks(record: MatrixRecord, figure: HeatmapFigure, cell: Cell) -> list[TileMark]:
    marks = []
    if number := violated(cell):
        marks.append(TileMark("\u2717", f"{number} violated", "bad"))
    if cell.failed:
        marks.append(TileMark("!", f"{cell.failed} failed", "bad"))
    if cell.unsupported:
        marks.append(TileMark("\u2013", f"{cell.unsupported} not supported", "good"))
    for change in record.against.changes if record.against else ():
        if change.point == cell.point and change.metric == figure.metric.name:
            up = change.now.mean is not None and change.before.mean is not None and change.now.mean > change.before.mean
            text, kind = ("worse", "bad") if change.worse else ("better", "good")
            marks.append(TileMark("\u25b2" if up else "\u25bc", text, kind))
    if cell.runs < (asked := len(record.matrix.seed_list)):
        marks.append(TileMark("\u2026", f"{cell.runs} of {asked} runs", "good"))
    return marks
