"""`ucp-harness check`: judge a run again, or exports from anywhere."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness import checker
from harness.archive.archive import RunArchive
from harness.checker.survival import survival
from harness.commands.terminal import complain, print_json, show_programs, show_result, show_survival
from harness.errors import CANNOT_HERE, VIOLATED, WRONG_REQUEST
from harness.report.agent_programs import programs


def check_command(
    paths: Annotated[list[Path], typer.Argument(help="A run directory, or chain exports from anywhere.")],
    as_json: Annotated[bool, typer.Option("--json", help="The verdict as JSON on standard output.")] = False,
) -> None:
    """Decide the six characteristics from exported chains, and from traces beside them."""
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
