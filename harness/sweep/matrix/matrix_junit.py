"""junit.xml: a test case for each cell."""

from collections.abc import Iterator

from harness.present.junit import Case, to_xml
from harness.sweep.matrix.matrix_record import MatrixRecord
from harness.sweep.matrix.matrix_table import name_of, troubles, unsupported


def to_junit(record: MatrixRecord) -> str:
    """A cell fails if a run of it violated a characteristic or failed, or if it is worse than the baseline; a cell
    without all its runs is skipped, and one that an agent does not support."""
    return to_xml(record.matrix.name, "matrix", record.started_at, record.wall_s, _cases(record))


def _cases(record: MatrixRecord) -> Iterator[Case]:
    cells = {cell.point: cell for cell in record.cells}
    for point in record.matrix.points:
        name, cell = name_of(record.matrix, point), cells.get(point)
        if wrong := list(troubles(record, cell)) if cell else []:
            yield Case(name, wrong)
        elif lacking := list(unsupported(record, cell)) if cell else []:
            yield Case(name, skipped="; ".join(lacking))
        elif cell is None or cell.runs < len(record.matrix.seed_list):
            ended = cell.runs if cell else 0
            yield Case(name, skipped=f"interrupted: {ended} of {len(record.matrix.seed_list)} runs had ended")
        else:
            yield Case(name)
