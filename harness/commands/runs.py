"""Implement `ucp-harness runs` and `scenarios`, which list recorded runs and the included scenarios."""

import webbrowser
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from harness.archive.directory import RUNS, PastRun, past_runs
from harness.archive.run_record import RunRecord
from harness.commands.terminal import MARKS, STYLES, complain, output, print_json
from harness.errors import RunDirectoryError
from harness.scenario import load
from harness.scenario.expect import AS_EXPECTED
from harness.scenario.verdict_names import BAD_IN_WORDS, Kind, kind_of


def runs_command(
    folder: Annotated[Path, typer.Argument(help="Folder of run directories.")] = RUNS,
    most: Annotated[int, typer.Option("--last", min=1, help="Maximum number of runs to list.")] = 20,
    opened: Annotated[
        int | None, typer.Option("--open", min=1, metavar="N", help="Open the report of run N of the list.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False,
) -> None:
    """List past runs with their verdicts, or open a report."""
    runs = list(past_runs(folder, max(most, opened or 0)))
    if opened is not None:
        _open(runs, opened, folder)
    elif as_json:
        print_json([_document(run) for run in runs])
    else:
        output().print(_table(runs) if runs else f"{folder} has no runs", highlight=False)
    for run in runs:
        if run.problem:
            complain(run.problem)


def _open(runs: list[PastRun], number: int, folder: Path) -> None:
    if number > len(runs):
        raise RunDirectoryError(f"{folder} has {len(runs)} runs, and no run {number}")
    report = runs[number - 1].report
    if not report.exists():
        raise RunDirectoryError(f"{report} does not exist: `ucp-harness report {report.parent}` writes it")
    typer.echo(report)
    webbrowser.open(report.absolute().as_uri())


def _table(runs: list[PastRun]) -> Table:
    table = Table("", "began", "scenario", "seed", "backend", "verdict", "directory", box=None, padding=(0, 2, 0, 0))
    for number, run in enumerate(runs, 1):
        record, (kind, words) = run.record, _verdict(run.record)
        verdict = Text(f"{MARKS[kind]} {words}", style=STYLES[kind])
        seed = "" if record.seed is None else str(record.seed)
        name = record.scenario.name if record.scenario else ""
        began, backend = Text(_local(record.started_at), no_wrap=True), record.backend or ""
        table.add_row(str(number), began, Text(name), seed, backend, verdict, Text(run.path.name))
    return table


def _verdict(record: RunRecord) -> tuple[Kind, str]:
    """Return a short summary of all verdicts of a run, and its class: good, bad or unknown."""
    kinds = {key: kind_of(judgement.verdict) for key, judgement in record.judgements.items()}
    bad = {key: BAD_IN_WORDS[key] for key, kind in kinds.items() if kind == "bad" and key in BAD_IN_WORDS}
    if bad:
        expected = all(record.expect.as_expected(key, record.judgements[key].verdict) for key in bad)
        return ("unknown", ", ".join([*bad.values(), AS_EXPECTED])) if expected else ("bad", ", ".join(bad.values()))
    if record.outcome != "completed":
        return "unknown", record.outcome
    unjudged = [key for key, kind in kinds.items() if kind == "unknown"]
    if unjudged or not kinds:
        return "unknown", f"not judged: {', '.join(unjudged)}" if unjudged else "not judged"
    return "good", "all good"


def _local(started_at: str | None) -> str:
    try:
        return datetime.fromisoformat(started_at or "").astimezone().strftime("%d %b %H:%M")
    except (ValueError, OverflowError, OSError):
        return ""


def _document(run: PastRun) -> dict[str, object]:
    record = run.record
    return {
        "directory": str(run.path),
        "report": str(run.report) if run.report.exists() else None,
        "started_at": record.started_at,
        "scenario": record.scenario.name if record.scenario else None,
        "seed": record.seed,
        "backend": record.backend,
        "outcome": record.outcome,
        "verdicts": {key: judgement.verdict for key, judgement in record.judgements.items()},
        "problem": run.problem,
    }


def scenarios_command() -> None:
    """List the scenarios that come with the harness.

    For example, `ucp-harness run loss_15` plays the scenario loss_15.
    """
    table = Table.grid(padding=(0, 2))
    for name in load.scenario_names():
        table.add_row(Text(name, style="bold", no_wrap=True), Text(load.first_sentence(name)))
    console = output()
    console.print(table)
    console.print(f"in {load.LIBRARY}, to copy and edit", highlight=False, soft_wrap=True, style="dim")
