"""Implement `ucp-harness doctor` and `clean`, which examine this machine and remove the leftovers of killed runs."""

from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from harness.commands.terminal import output, print_json
from harness.errors import CANNOT_HERE, VIOLATED
from harness.play.machine import capabilities
from harness.play.machine.capabilities import examine
from harness.play.machine.uml_kernel import UmlKernel, run_inside


def doctor_command(
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
    measure: Annotated[
        bool, typer.Option("--measure", help="Also measure what the network does to packets; up to a minute.")
    ] = False,
    kernel: Annotated[
        UmlKernel, typer.Option(help="Kernel to examine: this machine's, or User Mode Linux.")
    ] = UmlKernel.host,
) -> None:
    """Report what this machine can do, and how to enable the rest.

    Exit status 0: this machine can play runs. 1: with --measure, an engine deviates. 3: a needed feature is missing.
    """
    if kernel is UmlKernel.uml:
        asked = {"--json": as_json, "--measure": measure}
        raise typer.Exit(run_inside(["doctor", *(option for option, wanted in asked.items() if wanted)]))
    requirements = examine()
    able = all(requirement.ok for requirement in requirements if requirement.needed)
    if not as_json:
        table = Table.grid(padding=(0, 2))
        for requirement in requirements:
            mark = (
                Text("✔", style="green")
                if requirement.ok
                else Text("✘", style="red" if requirement.needed else "yellow")
            )
            table.add_row(mark, requirement.name, Text(requirement.detail))
            if not requirement.ok and requirement.way_out:
                table.add_row("", "", Text(f"→ {requirement.way_out}", style="dim"))
        output().print(table)
    engines = []
    if measure and able:
        with capabilities.progress_line(Console(stderr=True)) as show_progress:
            engines = capabilities.measure_engines(requirements, show_progress)
    records = [requirement.to_json() for requirement in requirements]
    if as_json:
        print_json({"findings": records, "measured": [engine.to_json() for engine in engines]} if measure else records)
    elif engines:
        output().print(capabilities.render(engines))
    if not able:
        raise typer.Exit(CANNOT_HERE)
    if not all(engine.ok for engine in engines):
        raise typer.Exit(VIOLATED)


def clean_command() -> None:
    """Remove the keys and containers of killed runs.

    The keys and containers of active runs, and the containers of other programs, stay.
    """
    from harness.play.containers.docker_engine import DockerEngine
    from harness.play.containers.ownership import clean
    from harness.play.memory_directory import KEYS_PREFIX, remove_abandoned

    console = output()
    for directory in remove_abandoned(KEYS_PREFIX):
        console.print(f"removed {directory}", highlight=False, soft_wrap=True)
    engine = DockerEngine.connect()
    try:
        cleaned = clean(engine)
    finally:
        engine.close()
    for name in cleaned.removed:
        console.print(f"removed {name}", highlight=False, soft_wrap=True)
    if not cleaned.removed:
        console.print("no containers to remove", highlight=False)
    if cleaned.still:
        console.print(f"{len(cleaned.still)} containers belong to active runs and stay", highlight=False, style="dim")
