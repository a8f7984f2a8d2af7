"""Create the table of cells and nights. Each field shows whether the cell had violations or changes in this night."""

from collections.abc import Sequence
from dataclasses import dataclass

from harness.present import text
from harness.sweep.matrix._matrix_file import MatrixPoint
from harness.sweep.matrix.matrix_record import MatrixRecord
from harness.sweep.matrix.matrix_table import name_of, violated


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


def columns(nights: Sequence[MatrixRecord]) -> list[NightColumn]:
    return [
        NightColumn(night.started_at[5:10], night.versions.get("commit", "unknown"), text.started(night.started_at))
        for night in nights
    ]


def rows(nights: Sequence[MatrixRecord], tonight: MatrixRecord) -> list[tuple[str, list[NightCell]]]:
    """Return the name of each cell in the matrix of this night, with one table field for each night."""
    return [
        (name_of(tonight.matrix, point), [_field(night, point) for night in nights]) for point in tonight.matrix.points
    ]


def _field(night: MatrixRecord, point: MatrixPoint) -> NightCell:
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
