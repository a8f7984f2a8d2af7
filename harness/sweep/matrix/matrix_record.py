"""What matrix.json says, schema `ucp-matrix/1`. Keys are added, never removed or renamed."""

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.backend_names import BackendName
from harness.errors import CANNOT_HERE, INTERRUPTED, VIOLATED
from harness.sweep.matrix._cell import Cell, Placed
from harness.sweep.matrix._comparison import Comparison
from harness.sweep.matrix._growth import Growth
from harness.sweep.matrix._matrix_coverage import Tried
from harness.sweep.matrix._matrix_file import Matrix

SCHEMA = "ucp-matrix/1"


class RunWithoutResult(Placed):
    """A run without a result, and why."""

    seed: int
    reason: str


class MatrixRecord(BaseModel):
    """One matrix. `matrix` is the file as resolved; a cell for each point of which a run has ended.

    `started_at` is when it was begun; `wall_s` is of the last command, if it was interrupted and went on. `against` is
    what changed since the night that it was compared with.
    """

    model_config = ConfigDict(populate_by_name=True)

    schema_: Literal["ucp-matrix/1"] = Field(default="ucp-matrix/1", alias="schema")
    matrix: Matrix
    backend: BackendName | Literal["several"]
    versions: dict[str, str]
    started_at: str
    wall_s: float
    outcome: Literal["completed", "interrupted"]
    cells: list[Cell]
    failed: list[RunWithoutResult] = []
    unsupported: list[RunWithoutResult] = []
    """Those in which an agent said that it lacks what they need."""
    against: Comparison | None = None
    tried: Tried | None = None
    """How much of the protocol the runs have tried, if that was asked for."""
    growths: list[Growth] = []
    """Power laws, if the matrix has several sizes of swarm or mission."""

    @property
    def runs(self) -> int:
        return sum(cell.runs for cell in self.cells)

    @property
    def runs_asked(self) -> int:
        return len(self.matrix.points) * len(self.matrix.seed_list)

    @property
    def exit_status(self) -> int:
        """As documented for the command line; a run that failed counts like an agent that did.

        What is not supported is neither good nor bad, and this machine's agents cannot do it.
        """
        if self.outcome == "interrupted":
            return INTERRUPTED
        regressed = self.against is not None and self.against.regressions
        if self.failed or regressed or any(cell.violated for cell in self.cells):
            return VIOLATED
        return CANNOT_HERE if self.unsupported else 0

    def to_json(self) -> dict[str, Any]:
        return self.model_dump(mode="json", by_alias=True)
