"""The matrix: one scenario over loss rates, numbers of agents, mission lengths, backends and seeds.

The runs use all cores of this machine or a Dask cluster.

_matrix_file.py      the matrix file
matrix_run.py        all runs of a matrix
_cell_play.py        one run
_cell.py             all runs at one point, summed up
_estimate.py         the metrics of a run, and a mean or a share with its 95 % interval
_growth_metrics.py   further metrics, if the matrix has three sizes of swarm or mission
_growth.py           power laws fitted to the runs
_power_law.py        the fit of one power law
_matrix_coverage.py  how much of the protocol the runs have tried
_results_file.py     results.jsonl, from which an interrupted matrix goes on
_cluster.py          the runs on a Dask cluster
matrix_record.py     matrix.json
matrix_outputs.py    all other files
matrix_summary.py    summary.md
_matrix_picture.py   matrix.svg
_growth_picture.py   growth.svg
_cell_scenarios.py   the scenario of each cell
report/              report.html
matrix_table.py      the table on the terminal
_growth_table.py     the tables of growth
matrix_frame.py      the runs as a DataFrame
nights.py            earlier nights of a matrix
_comparison.py       the difference from an earlier night

../../../docs/matrix-nightly.md explains a matrix on a build server. ../../../docs/generate/ has the programs that write
the results of two matrices into ../../../docs/matrix-thesis.md and ../../../docs/complexity.md.
"""

from harness.sweep.matrix._matrix_file import Matrix, load_matrix
from harness.sweep.matrix.matrix_record import MatrixRecord
from harness.sweep.matrix.matrix_run import Finished, run_matrix

__all__ = ["Finished", "Matrix", "MatrixRecord", "load_matrix", "run_matrix"]
