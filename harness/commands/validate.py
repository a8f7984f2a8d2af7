"""`ucp-harness validate`: recorded runs, held against the specification in TLA+."""

from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from harness.commands.terminal import Watcher, complain, print_json, print_lines
from harness.proof import specification
from harness.scenario import load_scenario


def validate_command(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="RUN...", help="Run directories, directories of traces, or traces."),
    ] = None,
    scenario: Annotated[
        Path | None, typer.Option(help="Scenario (name or YAML file) to play and validate as well.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds for --scenario.")] = 1000,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Compare recorded runs with the TLA+ specification.

    Exit status 0: each step is as specified. 1: an agent deviates. 2: a record is not readable. 3: TLC is not
    installed. 130: interrupted; the result covers the runs before.
    """
    if not runs and scenario is None:
        raise typer.BadParameter("name runs, or a --scenario to play")
    those = specification.recorded(runs or ())
    count = len(runs or ())
    if scenario is not None:
        those = chain(those, specification.simulated(load_scenario(scenario), range(seeds)))
        count += seeds
    with Watcher() as watcher:
        validation = specification.validate(
            those,
            watch=lambda done: watcher.show(f"{done.runs:,} of {count:,} runs, {done.steps:,} handler runs looked at"),
        )
    if as_json:
        print_json(validation.to_json())
    else:
        print_lines(validation.in_words())
    if validation.interrupted:
        complain("interrupted")
    raise typer.Exit(validation.exit_status)
