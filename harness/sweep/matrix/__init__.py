"""The matrix: one scenario over loss rates, numbers of agents, backends and many seeds, on all cores or a Dask cluster.

_matrix_file.py       what is asked: the matrix file       _estimate.py   a mean or a share with its 95 % interval
_estimate.py     what is measured of each run         _cell.py       all runs at one point, summed up
_cell_play.py        one run                              _results_file.py    results.jsonl, from which a matrix goes on
matrix_run.py         all of them                          _cluster.py    spread over a Dask cluster
matrix_record.py      matrix.json                          nights.py, _comparison.py   beside an earlier night
matrix_frame.py   its runs as a DataFrame
matrix_outputs.py     the files                            matrix_summary.py  matrix_outputs.py  _matrix_picture.py
_cell_scenarios.py   some of them
report/        report.html                          nights.py     what its trend is drawn from
matrix_table.py       the table on the terminal
../../../docs/generate/matrix_thesis.py      ../../../docs/matrix-thesis.md: the figures beside what Section 4.3
observed ../../../docs/matrix-nightly.md     a matrix every night, on a build server
"""

from harness.sweep.matrix._matrix_file import Matrix, load_matrix
from harness.sweep.matrix.matrix_record import MatrixRecord
from harness.sweep.matrix.matrix_run import Finished, run_matrix

__all__ = ["Finished", "Matrix", "MatrixRecord", "load_matrix", "run_matrix"]
