"""Return the runs of a matrix as a polars DataFrame, for notebooks."""

from harness.report.export.frames import pl
from harness.scenario.verdict_names import CHARACTERISTICS, ENDED, FURTHER_CHECKS
from harness.sweep.matrix.matrix_outputs import run_rows
from harness.sweep.matrix.matrix_run import Finished

_TYPES = {
    "agents": pl.Int64,
    "backend": pl.String,
    "seed": pl.Int64,
    **{f"characteristic_{number}": pl.String for number in CHARACTERISTICS},
    **dict.fromkeys((*FURTHER_CHECKS, ENDED), pl.String),
    "failed": pl.String,
    "unsupported": pl.String,
}
"""Types of the table columns that are not numeric results."""


def matrix_frame(finished: Finished) -> pl.DataFrame:
    """Return a table with one row for each run of a matrix. The columns of the table are those of `runs.csv`.

    - `loss` (0 to 1), `agents`, `backend` and `seed` identify the run. `duration_s` also identifies the run if the
      matrix has several mission lengths.

    - The numeric results of run.json follow, such as `mutual_chain`, `distinct_chains` and `messages`. Unknown figures
      are null.
    - `characteristic_1` to `characteristic_6`, `steps`, `records` and `liveness` are verdicts. `ended` is `violated` if
      an agent crashed or hung.
    - `failed` or `unsupported` is the reason why a run has no verdict.

    Raises MachineError if the extra `data` is not installed.
    """
    rows = list(run_rows(finished.runs))
    names = dict.fromkeys(name for row in rows for name in row)
    return pl.DataFrame(rows, schema={name: _TYPES.get(name, pl.Float64) for name in names})
