"""Write the growth figures of a matrix into docs/appendix/growth.md: `python -m docs.generate.complexity RUN_DIR`.

The tables and the picture are computed from the matrix in RUN_DIR. The text around them is written by hand.
"""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from docs.generate.matrix_thesis import BEGIN, END, put_between_markers
from harness.present import text
from harness.sweep.matrix._growth_picture import draw_growth
from harness.sweep.matrix._growth_table import (
    LAW_METRICS,
    SIZE_METRICS,
    SYMBOLS,
    growth_tables,
    in_one_line,
    label,
    law_row,
    size_row,
)
from harness.sweep.matrix.matrix_record import MatrixRecord
from ucp.agent_files import write_atomically

__all__ = ["BEGIN", "END", "PAGE", "tables"]

PAGE = Path(__file__).parents[1] / "appendix/growth.md"
PICTURE = PAGE.with_name("growth.svg")


def tables(record: MatrixRecord) -> str:
    """Return two Markdown tables: the mean figures of missions of the middle length, and the exponents of the laws of
    growth.
    """
    return f"{_sizes(record)}\n{_exponents(record)}"


def _sizes(record: MatrixRecord) -> str:
    length = sorted(record.matrix.lengths)[len(record.matrix.lengths) // 2]
    body = [
        [text.percent(cell.loss), f"{cell.agents}", *size_row(cell)]
        for part in growth_tables(record)
        for cell in part.cells
        if cell.duration_s in (length, None)
    ]
    return _markdown([f"loss, {text.duration(length)}", "N", *_labels(SIZE_METRICS)], body)


def _exponents(record: MatrixRecord) -> str:
    body = []
    for part in growth_tables(record):
        for name, variable, laws in part.laws:
            if name.startswith("both"):
                fields = (
                    f"{exponent}<br><sub>{quality}</sub>" if quality else exponent
                    for exponent, quality in law_row(variable, laws)
                )
                load = name.removeprefix("both").removeprefix(", load").strip() or "any"
                body.append([part.name.removesuffix(" loss"), load, SYMBOLS[variable], *fields])
    return _markdown(["loss", "load", "exponent of", *_labels(LAW_METRICS)], body)


def _labels(names: Iterable[str]) -> Iterable[str]:
    return (in_one_line(label(name)) for name in names)


def _markdown(headers: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    lines = [headers, ["--:" for _ in headers], *body]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def main(run_dir: Path) -> None:
    record = MatrixRecord.model_validate_json((run_dir / "matrix.json").read_text(encoding="utf-8"))
    write_atomically(PAGE, put_between_markers(PAGE.read_text(encoding="utf-8"), tables(record)))
    write_atomically(PICTURE, draw_growth(record))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
