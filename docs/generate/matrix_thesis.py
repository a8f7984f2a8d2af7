"""Compare a matrix with the observations in Section 4.3 of the thesis: `python -m docs.generate.matrix_thesis RUN_DIR`.

The table and the picture are computed from the matrix in RUN_DIR. The text around them is written by hand.
"""

import sys
from pathlib import Path

from harness.present import text as words
from harness.sweep.matrix._cell import Cell
from harness.sweep.matrix._estimate import METRICS
from harness.sweep.matrix._matrix_picture import draw
from harness.sweep.matrix.matrix_record import MatrixRecord
from harness.sweep.matrix.matrix_table import say_interval, say_mean
from ucp.agent_files import write_atomically

PAGE = Path(__file__).parents[1] / "appendix/loss-matrix.md"
PICTURE = PAGE.with_name("loss-matrix.svg")
BEGIN, END = "<!-- table: begin -->\n", "<!-- table: end -->\n"

OBSERVED = {
    0.0: "one chain; no agent reconciles",
    0.1: "one chain, except for a few of the last blocks",
    0.15: "one chain, except for a few of the last blocks (Figure 4.3)",
    0.25: "no uniform chain; the mutual chain shrinks",
    0.3: "chains begin to differ noticeably (Figure 4.4)",
    0.5: "almost no mutual chain; agents reconcile again and again (Figure 4.5)",
    0.75: "not described",
    1.0: "no agent reconciles; each chain has its own blocks only (Figure 4.6)",
}


def table(record: MatrixRecord) -> str:
    """Return a Markdown table. Each row has a loss rate, the observation of the thesis, and the means with confidence
    intervals.
    """
    headers = ["loss", "Section 4.3", *(metric.label for metric in METRICS)]
    lines = [headers, ["--:", "---", *("--:" for _ in METRICS)], *map(_row, record.cells)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def put_between_markers(page: str, text: str) -> str:
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}{text}{END}{after}"


def _row(cell: Cell) -> list[str]:
    estimates = [(metric, cell.estimates[metric.name]) for metric in METRICS]
    figures = (f"{say_mean(*pair)}<br><sub>{say_interval(*pair)}</sub>" for pair in estimates)
    return [words.percent(cell.loss), OBSERVED.get(cell.loss, ""), *figures]


def main(run_dir: Path) -> None:
    record = MatrixRecord.model_validate_json((run_dir / "matrix.json").read_text(encoding="utf-8"))
    write_atomically(PAGE, put_between_markers(PAGE.read_text(encoding="utf-8"), table(record)))
    write_atomically(PICTURE, draw(record))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
