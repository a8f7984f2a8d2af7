"""`ucp-harness shell`: a shell in a vehicle's network, while a run goes on."""

import os
import shutil
from pathlib import Path
from typing import Annotated

import typer

from harness.commands.terminal import complain
from harness.errors import MachineError, RunDirectoryError
from harness.play.machine.running_runs import running, way_into
from harness.play.machine.uml_kernel import enter, runs_inside


def shell_command(
    run: Annotated[Path | None, typer.Argument(metavar="[RUN]", help="Directory of an active run.")] = None,
    vehicle: Annotated[
        int | None, typer.Argument(metavar="[VEHICLE]", min=1, help="Vehicle whose network to enter.")
    ] = None,
    command: Annotated[
        list[str] | None, typer.Argument(metavar="[-- COMMAND...]", help="Command to run instead of a shell.")
    ] = None,
) -> None:
    """Open a shell in the network of a vehicle of an active run.

    Use ping, tcpdump or ip there. Without RUN the command lists the active runs.
    """
    runs, inside = running(), runs_inside()
    if run is None:
        for path, vehicles in runs.items():
            typer.echo(f"{path}: vehicles {_listed(vehicles)}")
        for path in inside:
            typer.echo(f"{path}: in User Mode Linux")
        if not (runs or inside):
            complain("no run goes on that can be seen from here")
        return
    directory = run.resolve()
    if directory in inside:
        asked = ["shell", str(directory), *([] if vehicle is None else [str(vehicle)])]
        raise typer.Exit(enter(inside[directory], [*asked, *(["--", *command] if command else [])]))
    if directory not in runs:
        raise RunDirectoryError(
            f"nobody of {run} is to be seen here: its run is over, or has not begun; {_what_runs([*runs, *inside])}"
        )
    vehicles = runs[directory]
    if vehicle is None:
        typer.echo(f"{directory}: vehicles {_listed(vehicles)}")
        return
    if vehicle not in vehicles:
        raise RunDirectoryError(f"nobody is in vehicle {vehicle} of {run}: there are {_listed(vehicles)}")
    if shutil.which("nsenter") is None:
        raise MachineError("there is no nsenter here: install util-linux (apt install util-linux)")
    argv = command or [os.environ.get("SHELL", "/bin/sh")]
    if not command:
        complain(f"in the network of vehicle {vehicle}; `exit` leaves it, and the run goes on")
    way = way_into(vehicles[vehicle])
    os.execvp(way[0], [*way, *argv])  # noqa: S606 (Ctrl-C is the shell's, and so is the exit status)


def _listed(vehicles: dict[int, int]) -> str:
    return ", ".join(map(str, vehicles))


def _what_runs(runs: list[Path]) -> str:
    return "no other does" if not runs else f"there goes on {', '.join(map(str, runs))}"
