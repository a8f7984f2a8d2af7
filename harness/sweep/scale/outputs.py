"""What a sweep leaves in its directory.

scale.json   all of it, schema `ucp-scale/1`
scale.csv    one row a run; the last two columns are what it cost this machine
scale.svg    the picture
report.html  all of it to look at
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from harness.errors import MachineError
from harness.sweep.matrix.matrix_outputs import to_csv
from harness.sweep.scale._cell import Run
from harness.sweep.scale._metrics import MACHINE_METRICS
from harness.sweep.scale._page import to_html
from harness.sweep.scale._picture import draw
from harness.sweep.scale._run import Finished
from ucp.agent_files import write_atomically, write_json_atomically


def write(finished: Finished, directory: Path) -> None:
    """Raises MachineError if the disk refuses."""
    try:
        write_json_atomically(directory / "scale.json", finished.record.to_json())
        write_atomically(directory / "scale.csv", to_csv(_rows(finished.runs)))
        write_atomically(directory / "scale.svg", draw(finished.record))
        write_atomically(directory / "report.html", to_html(finished.record))
    except OSError as error:
        raise MachineError(f"{error.filename or directory} cannot be written: {error.strerror}") from None


def _rows(runs: Sequence[Run]) -> Iterable[dict[str, Any]]:
    machine = [metric.name for metric in MACHINE_METRICS]
    figures = list(dict.fromkeys(name for run in runs for name in run.figures if name not in ("agents", *machine)))
    for run in runs:
        yield {
            **run.size._asdict(),
            "seed": run.seed,
            **{name: run.figures.get(name) for name in figures},
            "violated": " ".join(run.violated),
            "failed": run.failed,
            **{f"machine_{name}": run.figures.get(name) for name in machine},
        }
