"""The matrix on the terminal: for each loss the means, and below them their 95 % intervals; then what went wrong."""

from collections.abc import Iterable

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from harness.checker.verdict import CHECKS
from harness.matrix.cell import Cell
from harness.matrix.estimate import Estimate
from harness.matrix.metrics import METRICS, Metric
from harness.matrix.record import MatrixRecord
from harness.report import words

NAMED = 5
"""More runs than these are counted, not named; matrix.json names them all."""


def render(record: MatrixRecord) -> RenderableType:
    table = Table(box=None, padding=(0, 1, 0, 0), header_style="dim")
    for header in ("loss", "runs", *(metric.label for metric in METRICS), "vio-\nlated"):
        table.add_column(header.replace(" ", "\n", 1), justify="right", vertical="bottom", no_wrap=True)
    for cell in record.cells:
        estimates = [(metric, cell.estimates[metric.name]) for metric in METRICS]
        means = (Text(say_mean(metric, estimate)) for metric, estimate in estimates)
        table.add_row(words.percent(cell.loss), str(cell.runs), *means, _violated(cell))
        if len(record.matrix.seed_list) > 1:
            table.add_row("", "", *(Text(say_interval(*one), style="dim") for one in estimates))
    notes = (Text(note, style="red") for note in (*_violations(record), *_failures(record)))
    return Group(table, Text(explanation(record) + unjudged(record), style="dim"), *notes)


def say(metric: Metric, estimate: Estimate) -> str:
    """Mean and interval on one line."""
    interval = say_interval(metric, estimate)
    return f"{say_mean(metric, estimate)} ({interval})" if interval else say_mean(metric, estimate)


def say_mean(metric: Metric, estimate: Estimate) -> str:
    if estimate.mean is None:
        return "\u2013"
    return _number(estimate.mean) if metric.unit == "number" else f"{_number(100 * estimate.mean)}\u00a0%"


def say_interval(metric: Metric, estimate: Estimate) -> str:
    """The bounds of a share's interval, which is lopsided; of a mean's, what to add and to take off."""
    if estimate.low is None or estimate.high is None:
        return ""
    if metric.unit == "share of runs":
        return f"{100 * estimate.low:.0f}\u2013{100 * estimate.high:.0f}\u00a0%"
    margin = (estimate.high - estimate.low) / 2
    return f"\u00b1{_margin(margin)}" if metric.unit == "number" else f"\u00b1{_margin(100 * margin)}\u00a0%"


def explanation(record: MatrixRecord) -> str:
    """What the numbers are, in a sentence."""
    seeds = len(record.matrix.seed_list)
    if seeds == 1:
        return "One run a cell, so there are no intervals."
    return f"Means of {seeds} runs a cell, the same seeds in each, and their 95 % intervals."


def unjudged(record: MatrixRecord) -> str:
    """A sentence if there are characteristics that no run could judge."""
    judged = {
        number for cell in record.cells for number, counts in cell.verdicts.items() if set(counts) - {"not applicable"}
    }
    never = [number for number in CHECKS if number not in judged]
    if not never or not record.cells:
        return ""
    return f" Not applicable in any run: characteristic{'s' if len(never) > 1 else ''} {', '.join(never)}."


def _violated(cell: Cell) -> Text:
    runs = len({seed for seeds in cell.violated.values() for seed in seeds})
    if cell.failed:
        return Text(f"{runs} + {cell.failed}", style="bold red")
    return Text(str(runs), style="bold red" if runs else "green")


def _violations(record: MatrixRecord) -> Iterable[str]:
    for cell in record.cells:
        for number, seeds in cell.violated.items():
            which = ", ".join(map(str, seeds[:NAMED])) + (", \u2026" if len(seeds) > NAMED else "")
            yield (
                f"{words.percent(cell.loss)} loss: characteristic {number} violated in {len(seeds)} of "
                f"{cell.runs} runs, seed{'s' if len(seeds) > 1 else ''} {which}"
            )


def _failures(record: MatrixRecord) -> Iterable[str]:
    for run in record.failed[:NAMED]:
        yield f"{words.percent(run.loss)} loss: seed {run.seed} failed: {run.reason}"
    if len(record.failed) > NAMED:
        yield f"and {len(record.failed) - NAMED} more runs failed"


def _number(number: float) -> str:
    """Three digits that mean something."""
    digits = 2 if abs(number) < 10 else 1 if abs(number) < 100 else 0
    text = f"{number:.{digits}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _margin(number: float) -> str:
    return f"{number:.2g}" if number < 99.5 else f"{number:.0f}"
