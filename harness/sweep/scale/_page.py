"""report.html: the picture, the figures of each size, and how they grow, for whoever would rather look."""

from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from harness.present import svg
from harness.present import text as words
from harness.report import html
from harness.sweep.scale import table
from harness.sweep.scale._metrics import BY_NAME
from harness.sweep.scale._picture import draw
from harness.sweep.scale.record import ScaleRecord

_TEMPLATE = Path(__file__).with_name("page.html.j2")
_STYLE = _TEMPLATE.with_name("page.css").read_text(encoding="utf-8")


@dataclass(frozen=True, slots=True)
class AtLoss:
    """Of one loss: a row of cells for each size, and the exponents of each power law with how good it is."""

    name: str
    heads: list[str]
    sizes: list[list[str]]
    grown_heads: list[str]
    grown: list[tuple[str, list[tuple[str, str]]]]


def to_html(record: ScaleRecord) -> str:
    """The page, which loads nothing else."""
    return html.render(
        _TEMPLATE,
        styles=[html.PAGE_STYLE + _STYLE, svg.STYLE],
        record=record,
        headline=_headline(record),
        summary=[
            f"{', '.join(map(str, record.scale.agents))} agents",
            f"{', '.join(f'{minutes:g}' for minutes in record.scale.minutes)} minutes",
            f"{words.value(record.runs)} runs in virtual time",
            f"begun {words.started(record.started_at)}",
        ],
        troubles=[*table.unsettled(record), *(text.plain for text in table.blemishes(record))],
        losses=[_at(record, loss) for loss in record.scale.loss],
        explanation=table.explanation(record),
        picture=Markup(draw(record)),  # noqa: S704 - it has escaped what is not ours
    )


def _headline(record: ScaleRecord) -> tuple[str, str]:
    """In words, and for the style sheet."""
    bad = len(record.blemishes)
    if bad:
        return f"{bad} of {record.runs} runs bad", "violated"
    return f"{record.runs} runs, none bad", "unknown" if record.outcome == "interrupted" else "holds"


def _at(record: ScaleRecord, loss: float) -> AtLoss:
    sizes = []
    for cell in record.cells:
        if cell.loss == loss:
            estimates = {**cell.estimates, **cell.machine}
            figures = (table.say(BY_NAME[name], estimates[name]) for name in table.SIZED)
            sizes.append([f"{cell.minutes:g}", str(cell.agents), *figures])
    grown = []
    for name, variable, its in table.rows(record, loss):
        laws = [its.get(metric) for metric in table.GROWN]
        exponents = [
            (table.say_exponent(law.exponents[variable]), table.say_quality(law)) if law else ("\u2013", "")
            for law in laws
        ]
        grown.append((f"{table.SYMBOLS[variable]} {name}", exponents))
    heads, grown_heads = ([_head(name) for name in names] for names in (table.SIZED, table.GROWN))
    return AtLoss(words.percent(loss), heads, sizes, grown_heads, grown)


def _head(name: str) -> str:
    """A metric's name, without the hyphens that it has for a narrow column."""
    return BY_NAME[name].label.replace("- ", "")
