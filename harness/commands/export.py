"""`ucp-harness export`: a run as files for the tools that people use."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness.commands.new_file import newly, refuse_existing
from harness.commands.terminal import complain, print_lines
from harness.errors import ExportError
from harness.export import Recording


def export_command(
    run: Annotated[Path, typer.Argument(help="A run directory, or one that `import` made.")],
    mcap: Annotated[
        Path | None, typer.Option(metavar="FILE", help="For Foxglove, Lichtblick and PlotJuggler; must be new.")
    ] = None,
) -> None:
    """Write tracks, links, chains, handler runs, MAVLink and logs of a run for other tools.

    What could not be read is said here, and in the file.
    """
    if mcap is None:
        raise ExportError("say what to write: --mcap FILE")
    refuse_existing([mcap])
    recording = Recording(run)
    with Console(stderr=True).status(f"reading {run}") as status:

        def progress(mission_s: float) -> None:
            status.update(f"{mission_s:.0f} s of {recording.end_s:.0f} s")

        with newly(mcap), mcap.open("xb") as file:
            from harness.export.mcap import write_mcap

            messages = write_mcap(recording, file, progress)
    for sentence in recording.problems:
        complain(sentence)
    print_lines([f"{messages} messages: {mcap}"])
