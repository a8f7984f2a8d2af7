"""Define the file matrix.json, the results of a matrix (schema `ucp-matrix/1`).

Later versions may add keys, but never remove or rename one.

The file also has the coverage: how much of the protocol the runs of a matrix reach, in total and for each combination
of values.
"""

from collections import defaultdict
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.backend_names import BackendName
from harness.errors import CANNOT_HERE, INCOMPLETE, INTERRUPTED, VIOLATED
from harness.proof import Bounds
from harness.proof.coverage import ReachedStates, existing, to_json
from harness.proof.coverage.reached import BRANCHES
from harness.sweep.matrix._cell import Cell, CellRecord, Run
from harness.sweep.matrix._comparison import Comparison
from harness.sweep.matrix._growth import Growth
from harness.sweep.matrix._matrix_file import Matrix, MatrixPoint

MOST_AGENTS, MOST_BLOCKS = 3, 3
"""The numbers of agents and blocks of a proof. The coverage of the runs is compared with the states of this proof."""


class CellCoverage(CellRecord):
    """The coverage of the runs with one combination of values. Only the runs that this command has carried out are
    included.
    """

    local_states: int
    pairs: int
    branches: int


class MatrixCoverage(BaseModel):
    """The coverage of all examined runs. `all_cells` is a `ucp-coverage/1` document."""

    runs: int
    all_cells: dict[str, Any]
    cells: list[CellCoverage]


class CoverageTally:
    """The agent states that the runs of a matrix have reached: in all runs together, and in the runs of each cell."""

    def __init__(self) -> None:
        self._runs = 0
        self._reached = ReachedStates()
        self._by_point: dict[MatrixPoint, ReachedStates] = defaultdict(ReachedStates)

    def add(self, point: MatrixPoint, reached: ReachedStates) -> None:
        self._runs += 1
        self._reached.add(reached)
        self._by_point[point].add(reached)

    def tried(self, matrix: Matrix, runs: int) -> MatrixCoverage:
        """Return the coverage of the runs so far. `runs` is the number of all runs, including those of earlier
        commands. The coverage of the earlier runs is unknown.
        """
        if runs > self._runs:
            self._reached.untold = f"an earlier command played {runs - self._runs} of {runs} runs"
        scenario = matrix.scenario_at(matrix.points[0])
        there = existing(Bounds(min(MOST_AGENTS, len(scenario.roster)), MOST_BLOCKS))
        return MatrixCoverage(
            runs=self._runs,
            all_cells=to_json(self._reached, there),
            cells=[
                CellCoverage(
                    **point._asdict(),
                    local_states=len(reached.states),
                    pairs=len(reached.pairs),
                    branches=sum(branch in reached.branches for branch in BRANCHES),
                )
                for point in matrix.points
                if (reached := self._by_point.get(point))
            ],
        )


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
