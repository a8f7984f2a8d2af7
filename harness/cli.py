"""The command line: `ucp-harness run`, `check`, `matrix`, `scale`, `explore` and `doctor`.

Exit status 0: ran, and no characteristic is violated. 1: at least one is violated, or an agent failed. 2: the request
was wrong. 3: this machine cannot do it. 130: interrupted.
"""

import json
import secrets
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from harness import checker, explore, matrix, progress, scale
from harness.doctor import examine
from harness.errors import CANNOT_HERE, VIOLATED, WRONG_REQUEST, HarnessError
from harness.matrix import outputs as matrix_outputs
from harness.matrix import table as matrix_table
from harness.matrix.record import MatrixRecord
from harness.run import Run, run
from harness.rundir import claim, default_path
from harness.scale import model as scale_model
from harness.scale import outputs as scale_outputs
from harness.scale import table as scale_table
from harness.scale.record import ScaleRecord
from harness.scenario import Scenario, load_scenario
from harness.sweep import cores

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Test harness for the Uniform Chain Protocol.",
)

STYLES = {"holds": "green", "violated": "bold red", "not applicable": "yellow"}
MARKS = {"holds": "✔", "violated": "✘", "not applicable": "-"}
EVIDENCE_SHOWN = 5


class Vehicles(StrEnum):
    ardupilot = "ardupilot"
    embedded = "embedded"
    none = "none"


class MatrixBackend(StrEnum):
    sim = "sim"


class RunBackend(StrEnum):
    process = "process"
    sim = "sim"


@app.command("run")
def run_command(
    scenario: Annotated[Path, typer.Argument(help="Scenario file (YAML).")],
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of all that we draw; drawn itself if not given.")
    ] = None,
    speedup: Annotated[float | None, typer.Option(help="Mission seconds per second of wall time.")] = None,
    vehicles: Annotated[Vehicles | None, typer.Option(help="Kind of vehicles, instead of the scenario's.")] = None,
    backend: Annotated[
        RunBackend, typer.Option(help="Real processes in a private network, or virtual time.")
    ] = RunBackend.process,
    out: Annotated[Path | None, typer.Option(help="Run directory; must be new or empty.")] = None,
) -> None:
    """Play a scenario, check the six characteristics, write a report."""
    console = Console()
    request = _with_options(load_scenario(scenario), speedup, vehicles)
    directory = (out or default_path(request.name)).absolute()
    chosen_seed = secrets.randbelow(2**32) if seed is None else seed
    console.print(f"{request.name}, seed {chosen_seed}, into {directory}", highlight=False, soft_wrap=True)
    if backend is RunBackend.sim and request.events.source == "mavlink":
        console.print("No vehicles fly in virtual time: events are random (Algorithm 21).", style="dim")
    shown = progress.for_console(console)
    try:
        finished = run(request, chosen_seed, directory, shown, backend.value)
    finally:
        shown.close()
    _show_result(console, finished.result)
    _show_end(console, finished)
    raise typer.Exit(finished.exit_status)


@app.command("check")
def check_command(
    paths: Annotated[list[Path], typer.Argument(help="A run directory, or chain exports from anywhere.")],
    as_json: Annotated[bool, typer.Option("--json", help="The verdict as JSON on standard output.")] = False,
) -> None:
    """Decide the six characteristics from exported chains, and from traces beside them."""
    evidence = checker.gather(paths)
    result = checker.check(evidence)
    if as_json:
        _print_json(result.to_json())
    else:
        _show_result(Console(), result)
    for error in result.errors:
        _complain(error)
    if result.violated:
        raise typer.Exit(VIOLATED)
    if result.errors or not evidence.exports:
        raise typer.Exit(WRONG_REQUEST)


@app.command("doctor")
def doctor_command(
    as_json: Annotated[bool, typer.Option("--json", help="The findings as JSON on standard output.")] = False,
) -> None:
    """Say what this machine can do, and what would let it do more."""
    findings = examine()
    if as_json:
        _print_json([finding.to_json() for finding in findings])
    else:
        table = Table.grid(padding=(0, 2))
        for finding in findings:
            mark = Text("✔", style="green") if finding.ok else Text("✘", style="red" if finding.needed else "yellow")
            table.add_row(mark, finding.name, Text(finding.detail))
            if not finding.ok and finding.way_out:
                table.add_row("", "", Text(f"→ {finding.way_out}", style="dim"))
        Console().print(table)
    if any(finding.needed and not finding.ok for finding in findings):
        raise typer.Exit(CANNOT_HERE)


@app.command("matrix")
def matrix_command(
    file: Annotated[Path, typer.Argument(metavar="MATRIX", help="Matrix file (YAML).")],
    backend: Annotated[MatrixBackend, typer.Option(help="What plays the runs.")] = MatrixBackend.sim,
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
    matrix_outputs.write(finished, directory)
    _end_sweep(finished.record, None if as_json else matrix_table.render(finished.record), directory / "matrix.svg")


@app.command("scale")
def scale_command(
    agents: Annotated[str, typer.Option(help="Numbers of agents, with commas.")] = scale_model.AGENTS,
    minutes: Annotated[str, typer.Option(help="Mission lengths in minutes, with commas.")] = scale_model.MINUTES,
    loss: Annotated[str, typer.Option(help="Loss at each receiver, a probability; several with commas.")] = (
        scale_model.LOSS
    ),
    seeds: Annotated[int, typer.Option(help="Runs of each size.")] = scale_model.SEEDS,
    settle: Annotated[float, typer.Option(help="Minutes to finish after the mission.")] = scale_model.SETTLE_MINUTES,
    out: Annotated[Path | None, typer.Option(help="Directory of the results; must be new or empty.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="scale.json on standard output, no table.")] = False,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at the same time; as many as cores if not given.")
    ] = None,
) -> None:
    """Fit how messages, bytes and time grow with agents and blocks, in the simulation; by default about 4 minutes."""
    request = scale.read_request(agents, minutes, loss, seeds, settle)
    directory = (out or default_path("scale")).absolute()
    claim(directory)
    finished = scale.run_scale(request, jobs or cores(), shown=True)
    scale_outputs.write(finished, directory)
    _end_sweep(finished.record, None if as_json else scale_table.render(finished.record), directory / "scale.svg")


@app.command("explore")
def explore_command(
    scenario: Annotated[Path, typer.Argument(help="Scenario file (YAML).")],
    seeds: Annotated[int, typer.Option(min=1, help="How many seeds to play at most.")] = 1000,
    first_seed: Annotated[int, typer.Option(min=0, help="The first of them.")] = 0,
    out: Annotated[Path | None, typer.Option(help="File of the smallest run; must be new.")] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at the same time; as many as cores if not given.")
    ] = None,
) -> None:
    """Play seed after seed in virtual time until a characteristic is violated; then find the smallest such run."""
    console = Console()
    request = load_scenario(scenario)
    with explore.watching(console) as watcher:
        seeds_asked = range(first_seed, first_seed + seeds)
        explored = explore.explore(request, str(scenario), seeds_asked, jobs or cores(), out, watcher=watcher)
    for line in explore.in_words(explored):
        console.print(line, highlight=False, soft_wrap=True, markup=False)
    for seed, reason in explored.searched.failed.items():
        _complain(f"there is no verdict on seed {seed}: {reason}")
    if explored.interrupted:
        _complain("interrupted")
    raise typer.Exit(explored.exit_status)


def main() -> NoReturn:
    """The console script: a user's mistake ends in one sentence and the right exit status, never in a traceback."""
    try:
        app()
    except HarnessError as error:
        _complain(str(error))
        sys.exit(error.exit_status)
    sys.exit(0)


def _with_options(scenario: Scenario, speedup: float | None, vehicles: Vehicles | None) -> Scenario:
    """The scenario as resolved: the command line's word comes before the file's."""
    document: dict[str, Any] = scenario.model_dump()
    if speedup is not None:
        if not 0 < speedup <= 1000:
            raise typer.BadParameter(f"{speedup:g} is not a speedup: it is more than 0 and at most 1000")
        document["speedup"] = speedup
    if vehicles is not None:
        document["vehicles"]["kind"] = vehicles.value
    return Scenario.model_validate(document)


def _show_result(console: Console, result: checker.Result) -> None:
    table = Table.grid(padding=(0, 2))
    for number, one in result.characteristics.items():
        verdict = Text(f"{MARKS[one.verdict]} {one.verdict}", style=STYLES[one.verdict])
        table.add_row(number, one.name, verdict, Text(one.reason))
        for finding in one.evidence[:EVIDENCE_SHOWN]:
            table.add_row("", "", "", Text(f"agent {finding.agent_id}: {finding.detail}", style="red"))
        if len(one.evidence) > EVIDENCE_SHOWN:
            table.add_row("", "", "", Text(f"and {len(one.evidence) - EVIDENCE_SHOWN} more in run.json or --json"))
    console.print(table)
    known = {name: value for name, value in result.figures.items() if value is not None}
    words = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in known.items())
    console.print(words, highlight=False, style="dim")


def _show_end(console: Console, finished: Run) -> None:
    if finished.played.outcome != "completed":
        _complain(f"{finished.played.outcome_detail}; what there was has been exported and checked")
    for error in finished.result.errors:
        _complain(error)
    for sentence in finished.played.unmatched_fates:
        _complain(f"{sentence}, so this run does not show what it was meant to")
    slow = [
        f"{vehicle} ({record['real_time_factor']:.2f})"
        for vehicle, record in finished.played.vehicles.items()
        if (record.get("real_time_factor") or 1.0) < 0.95
    ]
    if slow:
        _complain(f"vehicles {', '.join(slow)} did not keep up with the clock: choose a smaller --speedup")
    wall = f"{finished.wall_s:.0f}" if finished.wall_s >= 10 else f"{finished.wall_s:.1f}"
    console.print(f"{wall} s; report: {finished.report}", highlight=False, soft_wrap=True)


def _end_sweep(record: MatrixRecord | ScaleRecord, table: RenderableType | None, picture: Path) -> NoReturn:
    """Show what came out, as JSON if there is no table, and exit."""
    if table is None:
        _print_json(record.to_json())
    else:
        console = Console()
        console.print(table)
        console.print(f"{record.wall_s:.0f} s; {picture}", highlight=False, soft_wrap=True)
    if record.outcome == "interrupted":
        ended = f"the {record.runs} of {record.runs_asked} runs that had ended are in {picture.parent}"
        _complain(f"interrupted; {ended}")
    raise typer.Exit(record.exit_status)


def _print_json(document: Any) -> None:
    sys.stdout.write(json.dumps(document, indent=1) + "\n")


def _complain(sentence: str) -> None:
    Console(stderr=True).print(Text(f"ucp-harness: {sentence}", style="red"), soft_wrap=True)


if __name__ == "__main__":
    main()
