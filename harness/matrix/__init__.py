"""The matrix: one scenario over loss rates and many seeds, in the simulation, on all cores.

model.py     what is asked: the matrix file        estimate.py  a mean or a share with its 95 % interval
metrics.py   what is measured of each run          cell.py      all runs at one loss rate, summed up
run.py       the runs themselves                   record.py    matrix.json
outputs.py   the files     table.py  the terminal  picture.py   matrix.svg
thesis.py    THESIS.md: the figures beside what Section 4.3 observed
"""

from harness.matrix.model import Matrix, load_matrix
from harness.matrix.record import MatrixRecord
from harness.matrix.run import Finished, run_matrix

__all__ = ["Finished", "Matrix", "MatrixRecord", "load_matrix", "run_matrix"]
