"""Write tables of growth for the terminal, the page and Markdown: means for each size, and exponents of the power
laws.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from harness.present import text as words
from harness.sweep.matrix._cell import Cell
from harness.sweep.matrix._estimate import GROWTH_BY_NAME, Estimate, Metric
from harness.sweep.matrix._growth import Exponent, Growth, Law, Variable
from harness.sweep.matrix.matrix_record import MatrixRecord

SYMBOLS: dict[Variable, str] = {"agents": "N", "blocks": "B"}
UNKNOWN = "\u2013"
SIZE_METRICS = (
    "blocks", "load", "uniform", "finished", "committed_per_minute", "reconciles_per_block", "messages_per_block",
    "messages", "bytes",
)  # fmt: skip
LAW_METRICS = ("messages", "bytes", "messages_per_block", "messages_per_minute", "uniform_after_s")
EXPLANATION = (
    "load: blocks completed while one vote lasts; from load 1 on, agents complete blocks faster than they can commit "
    "them. Exponents of N agents and B blocks: least squares in logarithms, a point for each run, with 95\u00a0% "
    "intervals. n is the number of points, if some runs have no logarithm."
)


@dataclass(frozen=True, slots=True)
class GrowthTables:
    """The tables for one loss rate and one backend: a table of means, and a table of power laws. The second table has a
    row for each group of runs and each variable.
    """

    name: str
    cells: list[Cell]
    laws: list[tuple[str, Variable, dict[str, Law]]]


def growth_tables(record: MatrixRecord) -> Iterator[GrowthTables]:
    """Yield the tables for each backend and loss rate with a finished run. If the matrix has only one size, yield
    nothing.
    """
    for backend in record.matrix.backend if record.matrix.grows else ():
        for loss in record.matrix.loss:
            cells = [cell for cell in record.cells if (cell.backend, cell.loss) == (backend, loss)]
            laws = [growth for growth in record.growths if (growth.backend, growth.loss) == (backend, loss)]
            name = f"{words.percent(loss)} loss" + (f", {backend}" if len(record.matrix.backend) > 1 else "")
            if cells:
                yield GrowthTables(name, cells, _rows(laws))


def _rows(growths: Iterable[Growth]) -> list[tuple[str, Variable, dict[str, Law]]]:
    """Group the power laws by the runs to which they are fitted: over agents, then over blocks, then over both."""
    by_row: dict[tuple[float, str, Variable], dict[str, Law]] = {}
    for growth in growths:
        for variable in growth.over:
            key = len(growth.over) + (growth.over[0] == "blocks") / 2, runs_of(growth), variable
            by_row.setdefault(key, {})[growth.metric] = growth.law
    return [(name, variable, laws) for (_, name, variable), laws in sorted(by_row.items(), key=lambda item: item[0][0])]


def runs_of(growth: Growth) -> str:
    """Return a name for the runs to which a power law was fitted, such as "600 s, load < 1" or "both"."""
    names = []
    if growth.over == ("agents", "blocks"):
        names.append("both")
    elif growth.agents is not None:
        names.append(f"{growth.agents} agents")
    elif growth.duration_s is not None:
        names.append(words.duration(growth.duration_s))
    if growth.load != "any":
        names.append("load\u00a0" + {"below 1": "<", "from 1": "\u2265"}[growth.load] + "\u00a01")
    return ", ".join(names)


def label(name: str) -> str:
    """Return the title of a column. A hyphen shows where the title may be divided in a narrow column."""
    return "idle at end" if name == "finished" else GROWTH_BY_NAME[name].label


def in_one_line(label: str) -> str:
    return label.replace("- ", "")


def size_row(cell: Cell) -> list[str]:
    """Return the means of a cell, in the order of `SIZE_METRICS`."""
    share = Metric("finished", "", lambda _: None, "share of runs")
    return [
        say(share, cell.finished)
        if name == "finished"
        else say(GROWTH_BY_NAME[name], cell.estimates.get(name, Estimate(n=0)))
        for name in SIZE_METRICS
    ]


def law_row(variable: Variable, laws: dict[str, Law]) -> list[tuple[str, str]]:
    """Return the exponents of `variable` in the order of `LAW_METRICS`. Each exponent comes with the quality of its
    power law.
    """
    return [
        (say_exponent(law.exponents[variable]), say_quality(law)) if (law := laws.get(name)) else (UNKNOWN, "")
        for name in LAW_METRICS
    ]


def render(record: MatrixRecord) -> Iterator[RenderableType]:
    """Yield the growth tables for the terminal."""
    for part in growth_tables(record):
        yield Text(f"Growth at {part.name}", style="bold")
        sizes = _table(["s", "N", *map(label, SIZE_METRICS)])
        for cell in part.cells:
            sizes.add_row(*place(record, cell), *size_row(cell))
        yield sizes
        if part.laws:
            exponents = _table(["exponent of", *map(label, LAW_METRICS)])
            for name, variable, laws in part.laws:
                cells = law_row(variable, laws)
                exponents.add_row(f"{SYMBOLS[variable]} {name}".rstrip(), *(exponent for exponent, _ in cells))
                exponents.add_row("", *(Text(quality, "dim") for _, quality in cells))
            yield exponents
        yield Text()
    if record.matrix.grows:
        yield Text(EXPLANATION, style="dim")


def place(record: MatrixRecord, cell: Cell) -> list[str]:
    """Return the mission length in seconds and the number of agents of a cell, as text."""
    return [f"{record.matrix.scenario_at(cell.point).duration_s:g}", str(cell.agents)]


def say_exponent(exponent: Exponent) -> str:
    """Return a text with an exponent and half the width of its confidence interval."""
    margin = (exponent.high - exponent.low) / 2
    return f"{exponent.value:.2f}\u00b1" + (f"{margin:.2f}".lstrip("0") if margin < 0.995 else f"{margin:.2g}")


def say_quality(law: Law) -> str:
    """Return a text with the share of the variance that a power law explains. If runs were omitted, the text also
    contains the number of points.
    """
    explained = "" if law.r_squared is None else f"R\u00b2\u00a0{law.r_squared:.2f}".replace("0.", ".")
    return explained + (f" n\u00a0{law.n}" if law.left_out else "")


def say(metric: Metric, estimate: Estimate) -> str:
    if estimate.mean is None:
        return UNKNOWN
    return say_number(estimate.mean) if metric.unit == "number" else f"{100 * estimate.mean:.0f}\u00a0%"


def say_number(value: float) -> str:
    """Format a number with three significant digits: 0.012, 7.3, 482, 40.4k, 225M."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    for factor, unit in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= 0.9995 * factor:
            return f"{_digits(value / factor)}{unit}"
    return _digits(value)


def _digits(value: float) -> str:
    digits = max(0, 2 - math.floor(math.log10(abs(value)) + 1e-9)) - (abs(value) < 1)
    text = f"{value:.{min(digits, 6)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _table(headers: Sequence[str]) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0), header_style="dim")
    for header in headers:
        left = header == "exponent of"
        table.add_column(
            header if left else header.replace(" ", "\n"),
            justify="left" if left else "right",
            vertical="bottom",
            no_wrap=True,
        )
    return table
