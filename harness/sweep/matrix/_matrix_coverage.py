"""Measure how much of the protocol the runs of a matrix reach, in total and for each combination of values."""

from collections import defaultdict
from typing import Any

from pydantic import BaseModel

from harness.proof import Bounds
from harness.proof.coverage import ReachedStates, existing, to_json
from harness.proof.coverage.reached import BRANCHES
from harness.sweep.matrix._cell import CellRecord
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
    """The sum of the coverage of all runs."""

    def __init__(self) -> None:
        self._runs = 0
        self._reached = ReachedStates()
        self._by_point: dict[MatrixPoint, ReachedStates] = defaultdict(ReachedStates)

    def add(self, point: MatrixPoint, reached: ReachedStates) -> None:
        self._runs += 1
        self._reached.add(reached)
        self._by_point[point].add(reached)

    def tried(self, matrix: Matrix, runs: int) -> MatrixCoverage:
        """Return the coverage of the runs so far. `runs` is the number of all runs. It includes runs of earlier
        commands, whose coverage is unknown.
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
