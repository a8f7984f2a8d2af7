"""`ucp-harness check` and `ucp-harness report`: judge a run again, and write its report again."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness import checker, report
from harness.archive.archive import RunArchive
from harness.checker.survival import survival
from harness.commands.terminal import complain, print_json, show_programs, show_result, show_survival
from harness.errors import CANNOT_HERE, VIOLATED, WRONG_REQUEST, MachineError, RunDirectoryError
from harness.report.agent_programs import programs


def report_command(run: Annotated[Path, typer.Argument(help="Run directory.")]) -> None:
    """Write the report files of a run again.

    The files are report.html, report.md, junit.xml and chains.svg. The run may have been killed.
    """
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


def check_command(
    paths: Annotated[list[Path], typer.Argument(help="Run directory, or chain exports.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the verdict as JSON.")] = False,
) -> None:
    """Judge chain exports and traces by the six characteristics."""
    archive = RunArchive(*paths)
    evidence = checker.gather(archive)
    result, survived = checker.check(evidence), survival(evidence)
    if as_json:
        ran = [program.to_json() for program in programs(archive.record)]
        print_json({**result.to_json(), "survival": survived.model_dump(), "programs": ran})
    else:
        show_result(Console(), result)
        show_programs(Console(), archive.record)
        show_survival(Console(), survived)
    for error in result.errors:
        complain(error)
    if result.bad:
        raise typer.Exit(VIOLATED)
    if archive.record.outcome == "not supported":
        raise typer.Exit(CANNOT_HERE)
    if result.errors or not evidence.exports:
        raise typer.Exit(WRONG_REQUEST)
