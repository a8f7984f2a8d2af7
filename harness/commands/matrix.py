"""`ucp-harness matrix`: a scenario over loss rates and seeds."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from harness import matrix
from harness.commands.terminal import end_sweep
from harness.matrix import outputs, table
from harness.rundir import claim, default_path
from harness.sweep import cores


class Backend(StrEnum):
    sim = "sim"


def matrix_command(
    file: Annotated[Path, typer.Argument(metavar="MATRIX", help="Matrix file (YAML).")],
    backend: Annotated[Backend, typer.Option(help="What plays the runs.")] = Backend.sim,
    out: Annotated[Path | None, typer.Option(help="Directory of the results; must be new or empty.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="matrix.json on standard output, no table.")] = False,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at the same time; as many as cores if not given.")
    ] = None,
) -> None:
    """Play a scenario over loss rates and many seeds: figures with 95 % intervals, and what was violated."""
    request = matrix.load_matrix(file)
    directory = (out or default_path(request.name)).absolute()
    claim(directory)
    finished = matrix.run_matrix(request, jobs or cores(), shown=True)
    outputs.write(finished, directory)
    end_sweep(finished.record, None if as_json else table.render(finished.record), directory / "matrix.svg")
