"""The sweep on the terminal: means for each size, the exponents of how they grow, and what went wrong."""

import math
from collections.abc import Iterable, Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from harness.present import text as words
from harness.scenario.verdict_names import BAD_IN_WORDS
from harness.sweep.matrix._estimate import Estimate, Metric
from harness.sweep.scale._cell import Cell, Growth
from harness.sweep.scale._growth import Exponent, Law, Variable
from harness.sweep.scale._metrics import BY_NAME
from harness.sweep.scale.record import ScaleRecord

NAMED = 5
"""More runs than these are counted, not named; scale.json names them all."""
SYMBOLS: dict[Variable, str] = {"agents": "N", "blocks": "B"}
SIZED = (
    "blocks", "load", "uniform", "settled", "committed_per_minute", "reconciles_per_block", "messages_per_block",
    "messages", "bytes", "processor_s",
)  # fmt: skip
GROWN = ("messages", "bytes", "messages_per_block", "messages_per_minute", "uniform_after_s", "processor_s")


def render(record: ScaleRecord) -> RenderableType:
    parts: list[RenderableType] = []
    for loss in record.scale.loss:
        cells = [cell for cell in record.cells if cell.loss == loss]
        if cells:
            parts += [Text(f"{words.percent(loss)} loss", style="bold"), _sizes(cells)]
        if grown := rows(record, loss):
            parts += [_exponents(grown), Text()]
    parts.append(Text(explanation(record), style="dim"))
    return Group(*parts, *(Text(note, style="yellow") for note in unsettled(record)), *blemishes(record))


def rows(record: ScaleRecord, loss: float) -> list[tuple[str, Variable, dict[str, Law]]]:
    """Of which runs, over what, and a law per metric."""
    by_row: dict[tuple[float, str, Variable], dict[str, Law]] = {}
    for growth in (*record.growths, *record.machine_growths):
        if growth.loss == loss:
            for variable in growth.over:
                key = len(growth.over) + (growth.over[0] == "blocks") / 2, series(growth), variable
                by_row.setdefault(key, {})[growth.metric] = growth.law
    return [(name, variable, laws) for (_, name, variable), laws in sorted(by_row.items(), key=lambda item: item[0][0])]


def series(growth: Growth) -> str:
    """Which runs a growth is of, apart from their loss."""
    if growth.over == ("agents",):
        name = f"{growth.minutes:g}\u00a0min"
    elif growth.over == ("blocks",):
        name = f"{growth.agents} agents"
    else:
        name = "both"
    return name + {"any": "", "below 1": ", load\u00a0<\u00a01", "from 1": ", load\u00a0\u2265\u00a01"}[growth.load]


def say_law(law: Law) -> str:
    """0.31 N^1.98"""
    powers = " ".join(f"{SYMBOLS[name]}^{exponent.value:.2f}" for name, exponent in law.exponents.items())
    return f"{say_number(law.factor)} {powers}"


def say_exponent(exponent: Exponent) -> str:
    """With what to add and to take off."""
    margin = (exponent.high - exponent.low) / 2
    return f"{exponent.value:.2f}\u00b1" + (f"{margin:.2f}".lstrip("0") if margin < 0.995 else f"{margin:.2g}")


def say_quality(law: Law) -> str:
    """How much it explains, and of how many runs if not of all."""
    explained = "" if law.r_squared is None else f"R\u00b2\u00a0{law.r_squared:.2f}".replace("0.", ".")
    return explained + (f" n\u00a0{law.n}" if law.left_out else "")


def say(metric: Metric, estimate: Estimate) -> str:
    if estimate.mean is None:
        return "\u2013"
    return say_number(estimate.mean) if metric.unit == "number" else f"{100 * estimate.mean:.0f}\u00a0%"


def say_number(value: float) -> str:
    """As many digits as mean something: 0.012, 7.3, 482, 40.4k, 225M."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    for factor, unit in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= 0.9995 * factor:
            return f"{_digits(value / factor)}{unit}"
    return _digits(value)


def explanation(record: ScaleRecord) -> str:
    """What the numbers are."""
    seeds = record.scale.seeds
    return (
        f"{'One run' if seeds == 1 else f'Means of {seeds} runs'} a size. load: blocks completed in the time that a "
        "vote takes; from 1 on they come faster than they can be committed. Exponents of N agents and B blocks: least "
        "squares in logarithms, a run a point, with 95\u00a0% intervals; n points where other runs have no logarithm. "
        "Processor seconds are this machine's, all else is virtual."
    )


def unsettled(record: ScaleRecord) -> Iterable[str]:
    """A sentence for each loss at which runs were cut off before all agents were idle."""
    for loss in record.scale.loss:
        which = []
        for cell in record.cells:
            share = cell.estimates["settled"]
            if cell.loss == loss and share.mean is not None and share.mean < 1:
                count = round(share.n * (1 - share.mean))
                which.append(f"{cell.minutes:g} min {cell.agents} agents ({count} of {share.n})")
        if which:
            limit = f"{record.scale.settle_minutes:g} min"
            yield f"{words.percent(loss)} loss: not settled in {limit}, with figures up to then: {', '.join(which)}"


def _sizes(cells: Sequence[Cell]) -> Table:
    table = _table(["min", "N", *(BY_NAME[name].label for name in SIZED)])
    for cell in cells:
        estimates = {**cell.estimates, **cell.machine}
        figures = (say(BY_NAME[name], estimates[name]) for name in SIZED)
        table.add_row(f"{cell.minutes:g}", str(cell.agents), *figures)
    return table


def _exponents(grown: Sequence[tuple[str, Variable, dict[str, Law]]]) -> Table:
    table = _table(["exponent of", *(BY_NAME[name].label for name in GROWN)])
    for name, variable, its in grown:
        laws = [its.get(metric) for metric in GROWN]
        exponents = (say_exponent(law.exponents[variable]) if law else "\u2013" for law in laws)
        table.add_row(f"{SYMBOLS[variable]} {name}", *exponents)
        table.add_row("", *(Text(say_quality(law) if law else "", "dim") for law in laws))
    return table


def _table(headers: Iterable[str]) -> Table:
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


def blemishes(record: ScaleRecord) -> Iterable[Text]:
    """A line for each run without a result, or with a bad one, up to a number."""
    for run in record.blemishes[:NAMED]:
        what = f"failed: {run.failed}" if run.failed else f"{', '.join(BAD_IN_WORDS[key] for key in run.violated)}"
        size = f"{words.percent(run.loss)} loss, {run.minutes:g} min, {run.agents} agents"
        yield Text(f"{size}: seed {run.seed} {what}", style="red")
    if len(record.blemishes) > NAMED:
        yield Text(f"and {len(record.blemishes) - NAMED} more runs like these", style="red")


def _digits(value: float) -> str:
    digits = max(0, 2 - math.floor(math.log10(abs(value)) + 1e-9)) - (abs(value) < 1)
    text = f"{value:.{min(digits, 6)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
