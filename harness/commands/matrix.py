"""Implement `ucp-harness matrix`, which runs a scenario with many combinations of values and seeds."""

from pathlib import Path
from typing import Annotated, NoReturn

import typer

from harness.archive.directory import default_path
from harness.backend_names import BackendName
from harness.commands._shared_options import complete_scenario, seconds_of
from harness.commands.terminal import StatusLine, complain, end_sweep, print_json, print_lines
from harness.errors import INTERRUPTED
from harness.play.variant import Variant, load_variant
from harness.run.parallel import cores
from harness.run.variant_in_force import in_force
from harness.sweep import matrix
from harness.sweep.matrix import matrix_outputs, matrix_table
from harness.sweep.matrix import nights as nights_of_matrix
from harness.sweep.matrix.matrix_run import Spread, compare_with, name_changes, name_culprits, on_cluster, on_cores
from harness.sweep.matrix.nights import load_baseline
from harness.sweep.matrix.variant_comparison import compare_runs
from ucp.agent_files import write_atomically, write_json_atomically

NIGHTS = "Compare nights"
"""Title of the help panel for options that compare a matrix with earlier results."""


def matrix_command(
    file: Annotated[
        Path, typer.Argument(metavar="MATRIX", help="Matrix file (YAML).", autocompletion=complete_scenario)
    ],
    backend: Annotated[BackendName | None, typer.Option(help="Backend of all runs, instead of the file's.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Directory of results: new, empty, or of a matrix to continue.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print matrix.json instead of the table.")] = False,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Number of parallel runs; one for each core if not given.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="TCP://HOST:PORT", help="Dask scheduler whose workers play the runs.")
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(
            metavar="BASELINE", rich_help_panel=NIGHTS, help="Earlier matrix.json; exit status 1 if a result is worse."
        ),
    ] = None,
    coverage: Annotated[
        bool, typer.Option("--coverage", help="Also report how much of the protocol the runs reached; slower.")
    ] = False,
    secured: Annotated[
        bool, typer.Option("--secured", help="Secure the mission with fresh keys if it has none.")
    ] = False,
    variant: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Python file with a protocol variant to compare in pairs."),
    ] = None,
    nights: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            rich_help_panel=NIGHTS,
            help="Keep this night in DIR, and draw the trend of all nights in it.",
        ),
    ] = None,
    bisect: Annotated[
        str | None,
        typer.Option(
            metavar="TIME", rich_help_panel=NIGHTS, help="Find the commits that made results worse; time limit: 20m."
        ),
    ] = None,
    budget: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Start no run after this time (6h); the most uncertain cells first."),
    ] = None,
) -> None:
    """Play a scenario over loss rates, swarm sizes and many seeds.

    Mission lengths and backends can vary, too. The report has figures with 95 % intervals, and each violation. With
    three or more swarm sizes or mission lengths, it also has power laws for the growth of the figures.

    Exit status 0: no run is bad. 1: a run is bad or failed, or a figure is worse than in --against. 3: an agent does
    not support a run. 4: no run is bad, but some needed more time. With --variant, only runs of the variant count.
    """
    request = matrix.load_matrix(file, backend)
    if secured:
        request = request.model_copy(update={"scenario": request.scenario.secured()})
    baseline = load_baseline(against, request) if against else None
    nights_directory = nights_of_matrix.opened(nights) if nights else None
    directory = (out or default_path(request.name)).absolute()
    if variant is not None and (against, nights, scheduler, budget, coverage) != (None, None, None, None, False):
        others = "--against, --nights, --scheduler, --budget and --coverage"
        raise typer.BadParameter(f"--variant excludes {others}: leave them out")
    if bisect is not None and against is None:
        raise typer.BadParameter("--bisect needs --against: it searches the commits since the baseline")
    bisect_s = None if bisect is None else seconds_of("--bisect", bisect)
    budget_s = None if budget is None else seconds_of("--budget", budget)
    spread = on_cores(request, jobs or cores(), shown=True) if scheduler is None else on_cluster(scheduler, shown=True)
    if variant is not None:
        _compare_with_variant(request, load_variant(variant), directory, spread, as_json)
    elsewhere = scheduler is not None
    finished = matrix.run_matrix(request, directory, spread, covers=coverage, budget_s=budget_s, elsewhere=elsewhere)
    if baseline is not None:
        finished = name_changes(compare_with(finished, baseline), baseline, jobs or cores())
        if bisect_s is not None:
            with StatusLine() as status:
                finished = name_culprits(finished, baseline, bisect_s, status.show)
    earlier = None
    if nights_directory is not None:
        nights_of_matrix.keep(finished.record, nights_directory)
        earlier = nights_of_matrix.read(nights_directory, request)
        if earlier.left_out:
            complain(f"{earlier.said_left_out}; {earlier.left_out[0]}")
    matrix_outputs.write(finished, directory, earlier)
    if finished.record.outcome == "interrupted":
        complain(f"to continue, repeat the command with --out {directory}")
    if finished.record.tried is not None and not as_json:
        print_lines(matrix_table.describe_coverage(finished.record.tried))
    end_sweep(finished.record, None if as_json else matrix_table.render(finished.record), directory / "report.html")


def _compare_with_variant(
    request: matrix.Matrix, variant: Variant, directory: Path, spread: Spread, as_json: bool
) -> NoReturn:
    """Play the matrix with the original protocol and with the variant, each into its own directory. Then compare the
    results.
    """
    original = matrix.run_matrix(request, directory / "original", spread)
    matrix_outputs.write(original, directory / "original")
    if original.record.outcome == "interrupted":
        complain(f"to continue, repeat the command with --out {directory}")
        raise typer.Exit(INTERRUPTED)
    variant_directory = directory / f"{variant.name}-{variant.digest}"
    with in_force(variant):
        changed = matrix.run_matrix(request, variant_directory, spread)
    matrix_outputs.write(changed, variant_directory)
    comparison = compare_runs(variant, request, original, changed)
    page = directory / "comparison.md"
    write_atomically(page, comparison.to_markdown())
    write_json_atomically(directory / "comparison.json", comparison.to_json())
    if as_json:
        print_json(comparison.to_json())
    else:
        print_lines([*comparison.to_markdown().splitlines(), "", str(page)])
    if changed.record.outcome == "interrupted":
        complain(f"to continue, repeat the command with --out {directory}")
    raise typer.Exit(changed.record.exit_status)
