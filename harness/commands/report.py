"""`ucp-harness report`: draw the report of a run again."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from harness import report
from harness.archive.archive import RunArchive
from harness.commands.terminal import complain
from harness.errors import MachineError, RunDirectoryError


def report_command(run: Annotated[Path, typer.Argument(help="A run directory.")]) -> None:
    """Write report.html, report.md, junit.xml and chains.svg again, also of a run that was killed half-way."""
    left = report.read_source(RunArchive(run, skim=True))
    try:
        page = report.write(left)
    except RunDirectoryError as error:
        raise MachineError(f"{error}: make room or give yourself the right to write there") from None
    for sentence in _missing(left):
        complain(sentence)
    sys.stdout.write(f"{page}\n")


def _missing(left: report.ReportSource) -> Iterator[str]:
    """A sentence for everything that a whole run would have left and this one has not."""
    if left.archive.recorded and left.record.outcome == "running":
        yield "the run has not recorded its end: it is still going on, or it was killed"
    if not left.record.characteristics:
        yield f"there is no verdict: `ucp-harness check {left.run_dir}` judges what there is"
    yield from left.chains_missing
    yield from left.files_missing
