"""`ucp-harness matrix`: a scenario over loss rates, numbers of agents, mission lengths, backends and seeds."""

from pathlib import Path
from typing import Annotated

import typer

from harness.archive.directory import default_path
from harness.backend_names import BackendName
from harness.commands.terminal import complain, end_sweep, print_lines
from harness.run.parallel import cores
from harness.sweep import matrix
from harness.sweep.matrix import matrix_outputs, matrix_summary, matrix_table
from harness.sweep.matrix import nights as nights_of_matrix
from harness.sweep.matrix.matrix_run import compare_with, on_cluster, on_cores
from harness.sweep.matrix.nights import load_baseline


def matrix_command(
    file: Annotated[Path, typer.Argument(metavar="MATRIX", help="Matrix file (YAML).")],
    backend: Annotated[BackendName | None, typer.Option(help="Backend of all runs, instead of the file's.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Directory of results: new, empty, or that of a matrix to continue.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print matrix.json instead of the table.")] = False,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Number of parallel runs; one for each core if not given.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="TCP://HOST:PORT", help="Dask scheduler whose workers play the runs.")
    ] = None,
    against: Annotated[
        Path | None, typer.Option(metavar="BASELINE", help="Earlier matrix.json; exit status 1 if a figure is worse.")
    ] = None,
    coverage: Annotated[
        bool, typer.Option("--coverage", help="Also report how much of the protocol the runs reached; slower.")
    ] = False,
    secured: Annotated[
        bool, typer.Option("--secured", help="Secure the mission with fresh keys if it has none.")
    ] = False,
    nights: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Keep this night in DIR, and draw the trend of all nights in it."),
    ] = None,
) -> None:
    """Play a scenario over loss rates, swarm sizes and many seeds.

    Mission lengths and backends can vary, too. The report has figures with 95 % intervals, and each violation. With
    three or more swarm sizes or mission lengths, it also has power laws of how figures grow.

    Exit status 0: no run is bad. 1: a run is bad or failed, or a figure is worse than in --against. 3: an agent does
    not support a run. 4: no run is bad, but some needed more time.
    """
    request = matrix.load_matrix(file, backend)
    if secured:
        request = request.model_copy(update={"scenario": request.scenario.secured()})
    baseline = load_baseline(against, request) if against else None
    kept = nights_of_matrix.opened(nights) if nights else None
    directory = (out or default_path(request.name)).absolute()
    if scheduler is None:
        spread = on_cores(request, jobs or cores(), shown=True)
    else:
        spread = on_cluster(request, scheduler, shown=True)
    finished = matrix.run_matrix(request, directory, spread, covers=coverage)
    if baseline is not None:
        finished = compare_with(finished, baseline, str(against))
    earlier = None
    if kept is not None:
        nights_of_matrix.keep(finished.record, kept)
        earlier = nights_of_matrix.read(kept, request)
        if earlier.left_out:
            complain(f"{earlier.said_left_out}; {earlier.left_out[0]}")
    matrix_outputs.write(finished, directory, earlier)
    if finished.record.outcome == "interrupted":
        complain(f"to continue, repeat the command with --out {directory}")
    if finished.record.tried is not None and not as_json:
        print_lines(matrix_summary.describe_coverage(finished.record.tried))
    end_sweep(finished.record, None if as_json else matrix_table.render(finished.record), directory / "report.html")
