"""Play a scenario with all combinations (a matrix) of loss rate, number of agents, mission length, backend and seed.

`_matrix_file` is the file that a user writes. `matrix_run` plays all runs on all cores, or on a Dask cluster (`_away`),
and adds each result to `results.jsonl`, so that an interrupted matrix can continue. A cell is the set of runs that
differ only by their seed. `_cell` summarises each cell, with the confidence intervals of `_estimate`. With three or
more sizes of swarm or mission, `_growth` fits power laws. `nights` finds an earlier night, and `_comparison` compares
the cells with it. `matrix_outputs` writes all files.
"""

from harness.sweep.matrix._matrix_file import Matrix, load_matrix
from harness.sweep.matrix.matrix_record import MatrixRecord
from harness.sweep.matrix.matrix_run import Finished, run_matrix

__all__ = ["Finished", "Matrix", "MatrixRecord", "load_matrix", "run_matrix"]
