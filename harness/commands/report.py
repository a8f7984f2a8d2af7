"""Implement `ucp-harness check`, `report` and `watch`, which judge a run again, write its report, or show the run as a
film.
"""

import asyncio
import os
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.text import Text

from harness import checker, report
from harness.archive.archive import RunArchive
from harness.checker import stored_differences
from harness.checker.survival import survival
from harness.commands._shared_options import KeysOption, trusted_keys
from harness.commands.terminal import (
    StatusLine,
    complain,
    output,
    print_json,
    show_programs,
    show_result,
    show_survival,
)
from harness.errors import CANNOT_HERE, VIOLATED, WRONG_REQUEST, MachineError, RunDirectoryError
from harness.report.agent_programs import programs
from harness.report.live.server_process import require_packages
from harness.run.provenance import differing_versions, same_judge, versions

if TYPE_CHECKING:
    from harness.report.live.feed import ChangeFeed


def report_command(run: Annotated[Path, typer.Argument(help="Run directory.")]) -> None:
    """Write the report files of a run again.

    The files are report.html, report.md, junit.xml and chains.svg. The run may have been killed.
    """
    with StatusLine() as status:
        source = report.read_source(RunArchive(run, skim=True, report_progress=status.show))
    try:
        page = report.write(source)
    except RunDirectoryError as error:
        raise MachineError(f"{error}: free some disk space, or make the directory writable") from None
    for sentence in _missing(source):
        complain(sentence)
    sys.stdout.write(f"{page}\n")


def _missing(source: report.ReportSource) -> Iterator[str]:
    """Yield a sentence for each part of a complete run that is missing in this run."""
    if source.archive.recorded and source.record.outcome == "running":
        yield "the end of the run is not recorded: the run is still active, or it was killed"
    if not source.record.characteristics:
        yield f"the run has no verdict: `ucp-harness check {source.run_dir}` judges the files that exist"
    yield from source.chains_missing
    yield from source.files_missing


def check_command(
    paths: Annotated[list[Path], typer.Argument(help="Run directory, or chain exports.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the verdict as JSON.")] = False,
    keys: KeysOption = None,
) -> None:
    """Judge chain exports and traces by the six characteristics.

    Exit status 0: no verdict is bad. 1: a verdict is bad, or a file was edited after the run. 2: no export exists, or a
    file could not be read. 3: no verdict is bad, and an agent did not support the run. 4: the only bad verdict is `not
    finished`.
    """
    with StatusLine() as status:
        archive = RunArchive(*paths, keys=trusted_keys(keys), report_progress=status.show)
        evidence = checker.gather(archive)
        directories = [path for path in paths if path.is_dir()]
        if not archive.recorded and evidence.traces and directories:
            from harness.field.ingest import ingest_files  # `run` uses this module too, and needs no field records
            from harness.field.replay.field_evidence import field_evidence

            evidence = field_evidence(evidence, ingest_files(directories).largest())
        result, survived = checker.check(evidence), survival(evidence)
    stored = [*stored_differences(archive.record, result, survived)]
    differing = differing_versions(archive.record.versions, versions()) if archive.record.versions else []
    if as_json:
        used_programs = [program.to_json() for program in programs(archive.record)]
        differences = {"differs_from_stored": stored, "differing_versions": differing}
        print_json({**result.to_json(), "survival": survived.model_dump(), "programs": used_programs, **differences})
    else:
        show_result(output(), result, archive.record)
        show_programs(output(), archive.record)
        show_survival(output(), survived)
        if differing:
            output().print(
                Text(f"the run and this check differ in {'; '.join(differing)}", style="dim"), soft_wrap=True
            )
    for sentence in stored:
        complain(sentence)
    for error in result.errors:
        complain(error)
    altered = bool(stored) and same_judge(archive.record.versions)
    if altered:
        complain("the same checker wrote run.json, so a file was edited after the run")
    if altered or result.exit_status:
        raise typer.Exit(VIOLATED if altered else result.exit_status)
    if archive.record.outcome == "not supported":
        raise typer.Exit(CANNOT_HERE)
    if result.errors or not evidence.exports:
        raise typer.Exit(WRONG_REQUEST)


PORT = typer.Option(min=0, max=65535, help="Port of the page on 127.0.0.1; 0 selects a free one.")


def watch_command(
    run: Annotated[Path, typer.Argument(help="Run directory, or a directory made by `import`.")],
    port: Annotated[int, PORT] = 0,
) -> None:
    """Show a recorded run as a film in the browser.

    The film shows map, links, chains, votes and reconciles. Ctrl-C ends the command.
    """
    require_packages()
    from harness.report.live.feed import ChangeFeed

    feed = ChangeFeed(run)
    with closing(feed):
        try:
            asyncio.run(_show(feed, run, port))
        except KeyboardInterrupt:
            raise typer.Exit(0) from None


async def _show(feed: "ChangeFeed", run: Path, port: int) -> None:
    from harness.report.live.server import ChangeLog, LivePageServer, copy_finished_run

    with closing(ChangeLog()) as log:
        async with LivePageServer(log, run, live=False).open(port) as address:
            show_address(output(), address)
            await copy_finished_run(feed, log)
            await asyncio.Event().wait()


def show_address(console: Console, address: str) -> None:
    """Print the address of the page as a link. On a desktop, also open it in the browser."""
    console.print(Text("watch it at "), Text(address, style=f"link {address}"), sep="", soft_wrap=True)
    has_desktop = sys.platform == "darwin" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if console.is_terminal and has_desktop:
        webbrowser.open(address)
