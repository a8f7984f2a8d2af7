"""`ucp-harness report`: draw the report of a run again."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from harness import report
from harness.commands.terminal import complain
from harness.errors import MachineError, RunDirectoryError
from harness.exports import RUN_FILE, export_paths, read_exports
from harness.report.result import mapping, read_result
from harness.report.swarm import missing


def report_command(run: Annotated[Path, typer.Argument(help="A run directory.")]) -> None:
    """Write report.html and chains.svg again, also of a run that was killed half-way, and print the path."""
    result = read_result(run / RUN_FILE)
    try:
        page = report.write_report(run)
    except RunDirectoryError as error:
        raise MachineError(f"{error}: make room or give yourself the right to write there") from None
    for sentence in _missing(run, result):
        complain(sentence)
    sys.stdout.write(f"{page}\n")


def _missing(run: Path, result: dict[str, Any]) -> Iterator[str]:
    """A sentence for everything that a whole run would have left and this one has not."""
    if result.get("outcome") in (None, "running"):
        yield "the run has not recorded its end: it is still going on, or it was killed"
    if not mapping(result, "characteristics"):
        yield f"there is no verdict: `ucp-harness check {run}` judges what there is"
    exports = read_exports(export_paths(run))
    yield from missing(result, exports)
    yield from exports.errors
