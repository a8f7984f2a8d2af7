"""The matrix: one scenario over loss rates, numbers of agents, backends and many seeds, on all cores or a Dask cluster.

model.py       what is asked: the matrix file       estimate.py   a mean or a share with its 95 % interval
metrics.py     what is measured of each run         cell.py       all runs at one point, summed up
play.py        one run                              results.py    results.jsonl, from which a matrix goes on
run.py         all of them                          cluster.py    spread over a Dask cluster
record.py      matrix.json                          baseline.py, comparison.py   beside an earlier night
outputs.py     the files                            summary.py  junit.py  picture.py  scenarios.py   some of them
report/        report.html                          nights.py     what its trend is drawn from
table.py       the table on the terminal
thesis.py      THESIS.md: the figures beside what Section 4.3 observed
NIGHTLY.md     a matrix every night, on a build server
"""

from harness.matrix.model import Matrix, load_matrix
from harness.matrix.record import MatrixRecord
from harness.matrix.run import Finished, run_matrix

__all__ = ["Finished", "Matrix", "MatrixRecord", "load_matrix", "run_matrix"]
