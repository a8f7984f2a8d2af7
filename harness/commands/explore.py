"""Implement `ucp-harness explore`, which searches for a violation, or for new states for some time."""

import re
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness.archive.directory import RUNS
from harness.archive.recorded_scenario import load_recorded_scenario
from harness.commands._shared_options import complete_scenario, seconds_of
from harness.commands.terminal import complain, output, print_json
from harness.run.parallel import cores
from harness.scenario import Scenario
from harness.sweep import explore

HUNT = "Hunt for new states"


def explore_command(
    scenario: Annotated[
        Path,
        typer.Argument(
            metavar="SCENARIO|RUN",
            help="Scenario (name or YAML file), or run directory to start from.",
            autocompletion=complete_scenario,
        ),
    ],
    seeds: Annotated[
        int | None, typer.Option(min=1, help=f"Maximum number of seeds; {explore.SEEDS} if not given.")
    ] = None,
    first_seed: Annotated[
        int | None, typer.Option(min=0, help="First seed; the seed of RUN or 0 if not given.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="File for the smallest run with a violation; must be new.")] = None,
    secured: Annotated[
        bool, typer.Option("--secured", help="Secure the mission with fresh keys if it has none.")
    ] = False,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Number of parallel runs; one for each core if not given.")
    ] = None,
    for_time: Annotated[
        str | None,
        typer.Option(
            "--for",
            metavar="TIME",
            rich_help_panel=HUNT,
            help="Hunt for this time, such as 90s, 30m or 8h.",
        ),
    ] = None,
    runs: Annotated[
        int | None,
        typer.Option(min=1, rich_help_panel=HUNT, help="Hunt for this number of runs, determined by --first-seed."),
    ] = None,
    corpus: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", rich_help_panel=HUNT, help="Directory of runs and findings, which later hunts continue."
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", rich_help_panel=HUNT, help="Print the result of the hunt as JSON.")
    ] = False,
) -> None:
    """Play seeds until one violates a characteristic, and shrink it.

    With --for or --runs the command hunts instead. It changes events, fates, timings, partitions, deaths and settings,
    and keeps runs that reach new local states. Each run ends in a liveness phase. Findings are new, ongoing, rare or
    resolved compared with the previous hunt in the same --corpus.

    Exit status 0: no run has a bad verdict. 1: a run has a bad verdict or failed; for a hunt: a run failed, or a
    finding is not resolved. 4: without a hunt, the only bad verdict of a run is `not finished`. A hunt counts runs that
    did not finish, and ends with 0.
    """
    if for_time is not None or runs is not None:
        if seeds is not None or out is not None:
            raise typer.BadParameter(
                "--seeds and --out do not apply to a hunt (--for, --runs): leave them out; a hunt writes its findings "
                "into --corpus"
            )
        _hunt(scenario, secured, first_seed, for_time, runs, corpus, jobs, as_json)
    if corpus is not None or as_json:
        raise typer.BadParameter("--corpus and --json need a hunt: add --for TIME or --runs NUMBER")
    console = output()
    request, recorded_seed = _load_request(scenario, secured)
    if first_seed is None:
        first_seed = recorded_seed or 0
    with explore.watching(console) as watcher:
        requested_seeds = range(first_seed, first_seed + (seeds or explore.SEEDS))
        explored = explore.explore(request, requested_seeds, out, source=str(scenario), jobs=jobs, watcher=watcher)
    for line in explore.in_words(explored):
        console.print(line, highlight=False, soft_wrap=True, markup=False)
    for seed, reason in explored.searched.failed.items():
        complain(f"there is no verdict on seed {seed}: {reason}")
    if explored.interrupted:
        complain("interrupted")
    raise typer.Exit(explored.exit_status)


def _load_request(scenario: Path, secured: bool) -> tuple[Scenario, int | None]:
    """Return the scenario. If the argument is a run directory, also return the seed of the run."""
    request, recorded_seed = load_recorded_scenario(scenario)
    return request.secured() if secured else request, recorded_seed


def _hunt(
    scenario: Path,
    secured: bool,
    first_seed: int | None,
    for_time: str | None,
    runs: int | None,
    corpus: Path | None,
    jobs: int | None,
    as_json: bool,
) -> None:
    from harness.sweep.explore import guided  # slow: it imports the pages

    request, recorded_seed = _load_request(scenario, secured)
    directory = corpus or RUNS / _directory_name(request.name)
    with guided.watching(Console(stderr=True)) as watcher:
        night = guided.spend(
            request,
            directory,
            first_seed=recorded_seed or 0 if first_seed is None else first_seed,
            for_s=float("inf") if for_time is None else seconds_of("--for", for_time),
            most_runs=float("inf") if runs is None else runs,
            jobs=jobs or cores(),
            watcher=watcher,
        )
    if as_json:
        print_json(night.to_json())
    else:
        console = output()
        for line in guided.in_words(night):
            console.print(line, highlight=False, soft_wrap=True, markup=False)
    for sentence in night.left_out[:3]:
        complain(sentence)
    if len(night.left_out) > 3:
        complain(f"and {len(night.left_out) - 3} more files are left out")
    if night.interrupted:
        complain(f"interrupted: what was found by then is in {directory}")
    raise typer.Exit(night.exit_status)


def _directory_name(name: str) -> str:
    return f"{re.sub(r'[^A-Za-z0-9_-]+', '_', name)[:80]}-corpus"
