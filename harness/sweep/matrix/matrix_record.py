"""Define the file matrix.json, the results of a matrix (schema `ucp-matrix/1`).

Later versions may add keys, but never remove or rename one.
"""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.backend_names import BackendName
from harness.errors import CANNOT_HERE, INCOMPLETE, INTERRUPTED, VIOLATED
from harness.sweep.matrix._cell import Cell, CellRecord, Run
from harness.sweep.matrix._comparison import Comparison
from harness.sweep.matrix._growth import Growth
from harness.sweep.matrix._matrix_coverage import MatrixCoverage
from harness.sweep.matrix._matrix_file import Matrix

SCHEMA = "ucp-matrix/1"


class RunWithoutResult(CellRecord):
    """A run without a result, with the reason why it has none."""

    seed: int
    reason: str


class MatrixRecord(BaseModel):
    """The results of a matrix. `matrix` is the resolved matrix file. `cells` has a cell for each combination with at
    least one run that has ended.

    `started_at` is the start of the matrix. `wall_s` is the wall time of the command in seconds. If an interrupted
    matrix was continued, this is the last command. `against` contains the changes since the earlier night to compare
    with.
    """

    model_config = ConfigDict(populate_by_name=True)

    schema_: Literal["ucp-matrix/1"] = Field(default="ucp-matrix/1", alias="schema")
    matrix: Matrix
    backend: BackendName | Literal["several"]
    versions: dict[str, str]
    started_at: str
    wall_s: float
    outcome: Literal["completed", "interrupted"]
    budget_s: float | None = None
    """Seconds after which the command began no further run. Null if the time was not limited."""
    cells: list[Cell]
    failed: list[RunWithoutResult] = []
    unsupported: list[RunWithoutResult] = []
    """Runs in which an agent did not support a feature that the scenario needs."""
    against: Comparison | None = None
    results: list[Run] = []
    """The judged runs in virtual time. A later night can compare its runs with these runs, in pairs with the same
    seed.
    """
    tried: MatrixCoverage | None = None
    """The share of the protocol that the runs covered. Null if the user did not ask for it."""
    growths: list[Growth] = []
    """Power laws. They exist only if the matrix has several numbers of agents or several mission lengths."""

    @property
    def runs(self) -> int:
        return sum(cell.runs for cell in self.cells)

    @property
    def runs_asked(self) -> int:
        return len(self.matrix.points) * len(self.matrix.seed_list)

    @property
    def exit_status(self) -> int:
        """The exit status of the command `matrix`. A failed run counts as a bad one.

        Without a bad run, a run that only needed more time leads to status 4.

        Runs that an agent does not support are neither good nor bad. Without a bad run they lead to status 3.
        """
        if self.outcome == "interrupted":
            return INTERRUPTED
        regressed = self.against is not None and self.against.regressions
        if self.failed or regressed or any(cell.violated for cell in self.cells):
            return VIOLATED
        if any(cell.unfinished for cell in self.cells):
            return INCOMPLETE
        return CANNOT_HERE if self.unsupported else 0

    def to_json(self) -> dict[str, object]:
        return self.model_dump(mode="json", by_alias=True)
