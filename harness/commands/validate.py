"""`ucp-harness validate`: recorded runs, held against the specification in TLA+."""

from itertools import chain
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness import specification
from harness.commands.terminal import complain, print_json
from harness.scenario import load_scenario
from harness.specification import Validation


def validate_command(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="RUN...", help="Run directories, directories of what agents left, or traces."),
    ] = None,
    scenario: Annotated[
        Path | None, typer.Option(help="And a scenario to be played in virtual time, a file or its name,")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="with so many seeds.")] = 1000,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Hold recorded runs against the specification in TLA+, step by step: exit status 1 if an agent did anything else.

    2: something could not be looked at. 3: TLC is not here. 130: interrupted, and what is said is of what came before.
    """
    if not runs and scenario is None:
        raise typer.BadParameter("name runs, or a --scenario to play")
    those = specification.recorded(runs or ())
    count = len(runs or ())
    if scenario is not None:
        those = chain(those, specification.simulated(load_scenario(scenario), range(seeds)))
        count += seeds
    console = Console(stderr=True)

    def show(validation: Validation) -> None:
        status.update(f"{validation.runs:,} of {count:,} runs, {validation.steps:,} handler runs")

    with console.status("begins") as status:
        validation = specification.validate(those, watch=show)
    if as_json:
        print_json(validation.to_json())
    else:
        paper = Console()
        for line in validation.in_words():
            paper.print(line, highlight=False, soft_wrap=True, markup=False)
    if validation.interrupted:
        complain("interrupted")
    raise typer.Exit(validation.exit_status)
