"""`python -m docs.generate.complexity RUN_DIR`: put a sweep's figures into ../complexity.md.

The tables and the picture come from RUN_DIR; the words around them are written by hand.
"""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from docs.generate.matrix_thesis import BEGIN, END, put_between_markers
from harness.present import text
from harness.sweep.scale._metrics import BY_NAME
from harness.sweep.scale._picture import draw
from harness.sweep.scale.record import ScaleRecord
from harness.sweep.scale.table import GROWN, SIZED, SYMBOLS, rows, say, say_exponent, say_quality
from ucp.agent_files import write_atomically

__all__ = ["BEGIN", "END", "PAGE", "tables"]

PAGE = Path(__file__).parents[1] / "complexity.md"
PICTURE = PAGE.with_name("complexity.svg")


def tables(record: ScaleRecord) -> str:
    """Markdown: the means at the middle mission length, and the exponents over agents and blocks together."""
    return f"{_sizes(record)}\n{_exponents(record)}"


def _sizes(record: ScaleRecord) -> str:
    minutes = record.scale.minutes[len(record.scale.minutes) // 2]
    body = []
    for cell in record.cells:
        if cell.minutes == minutes:
            estimates = {**cell.estimates, **cell.machine}
            figures = (say(BY_NAME[name], estimates[name]) for name in SIZED)
            body.append([text.percent(cell.loss), f"{cell.agents}", *figures])
    return _markdown([f"loss, {minutes:g} min", "N", *map(_label, SIZED)], body)


def _exponents(record: ScaleRecord) -> str:
    body = []
    for loss in record.scale.loss:
        for name, variable, laws in rows(record, loss):
            if name.startswith("both"):
                its = [laws.get(metric) for metric in GROWN]
                figures = (
                    f"{say_exponent(law.exponents[variable])}<br><sub>{say_quality(law)}</sub>" if law else "\u2013"
                    for law in its
                )
                load = name.removeprefix("both").removeprefix(", load").strip() or "any"
                body.append([text.percent(loss), load, SYMBOLS[variable], *figures])
    return _markdown(["loss", "load", "exponent of", *map(_label, GROWN)], body)


def _label(metric: str) -> str:
    return BY_NAME[metric].label.replace("- ", "")


def _markdown(headers: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    lines = [headers, ["--:" for _ in headers], *body]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def main(run_dir: Path) -> None:
    record = ScaleRecord.model_validate_json((run_dir / "scale.json").read_text(encoding="utf-8"))
    write_atomically(PAGE, put_between_markers(PAGE.read_text(encoding="utf-8"), tables(record)))
    write_atomically(PICTURE, draw(record))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
