"""`ucp-harness explore`: look for a violation, and shrink it."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness import explore
from harness.archive.played import scenario_of
from harness.commands.terminal import complain
from harness.run.sweep import cores


def explore_command(
    scenario: Annotated[
        Path,
        typer.Argument(
            metavar="SCENARIO|RUN",
            help="A scenario's file (YAML), or the name of one that comes along; or a run, from its seed on.",
        ),
    ],
    seeds: Annotated[int, typer.Option(min=1, help="How many seeds to play at most.")] = 1000,
    first_seed: Annotated[
        int | None, typer.Option(min=0, help="The first of them; 0, or that of RUN, if not given.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="File of the smallest run; must be new.")] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at the same time; as many as cores if not given.")
    ] = None,
) -> None:
    """Play seed after seed in virtual time until a characteristic is violated; then find the smallest such run."""
    console = Console()
    request, own_seed = scenario_of(scenario)
    if first_seed is None:
        first_seed = own_seed or 0
    with explore.watching(console) as watcher:
        seeds_asked = range(first_seed, first_seed + seeds)
        explored = explore.explore(request, str(scenario), seeds_asked, jobs or cores(), out, watcher=watcher)
    for line in explore.in_words(explored):
        console.print(line, highlight=False, soft_wrap=True, markup=False)
    for seed, reason in explored.searched.failed.items():
        complain(f"there is no verdict on seed {seed}: {reason}")
    if explored.interrupted:
        complain("interrupted")
    raise typer.Exit(explored.exit_status)
