"""Implement `ucp-harness export`, which writes a run as files for Foxglove, PlotJuggler, Perfetto and ROS 2."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness.commands._shared_options import DepotKey, depot_of, refuse_existing, write_whole
from harness.commands.terminal import complain, print_lines
from harness.errors import ExportError
from harness.report.export import ExportedRun

Write = Callable[[ExportedRun, Path, Callable[[float], None]], int]


def export_command(
    run: Annotated[Path, typer.Argument(help="Run directory, or a directory made by `import`.")],
    mcap: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File for Foxglove, Lichtblick and PlotJuggler; must be new.")
    ] = None,
    perfetto: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File for ui.perfetto.dev; must be new.")
    ] = None,
    rosbag: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Bag for ROS 2, which `import` can read; must be new.")
    ] = None,
    depot_key: DepotKey = None,
) -> None:
    """Write a run for Foxglove, PlotJuggler, Perfetto or ROS 2.

    The files hold tracks, links, chains, handler runs, MAVLink and logs. Unreadable records are reported in the files
    and on standard error.
    """
    formats = ((mcap, "messages", _mcap), (perfetto, "events", _perfetto), (rosbag, "messages", _rosbag))
    asked = [(path, counted, writer) for path, counted, writer in formats if path is not None]
    if not asked:
        raise ExportError("no output is named: add --mcap FILE, --perfetto FILE or --rosbag DIR")
    refuse_existing([path for path, _, _ in asked])
    writers = [(path, counted, writer()) for path, counted, writer in asked]
    recording = ExportedRun(run, depot_of(depot_key))
    with Console(stderr=True).status(f"reading {run}") as status:
        for path, counted, write in writers:

            def progress(mission_s: float, path: Path = path) -> None:
                status.update(f"{path}: {mission_s:.0f} s of {recording.end_s:.0f} s")

            with write_whole(path):
                written = write(recording, path, progress)
            print_lines([f"{written} {counted}: {path}"])
    for sentence in recording.problems:
        complain(sentence)


# The command imports the packages of all formats before it writes. A missing package leaves no file behind.


def _mcap() -> Write:
    from harness.report.export.mcap_file import write_mcap

    return write_mcap


def _perfetto() -> Write:
    from harness.report.export.perfetto_file import write_perfetto

    return write_perfetto


def _rosbag() -> Write:
    from harness.report.export.rosbag_file import write_rosbag

    return write_rosbag
