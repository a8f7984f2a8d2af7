"""Implement `ucp-harness tell` and `shell`, which control an active run and open a shell in its network."""

import asyncio
import os
import re
import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from harness.commands.terminal import complain
from harness.errors import MachineError, RunDirectoryError, ScenarioError
from harness.play.machine.running_runs import enter_command, running
from harness.play.machine.uml_kernel import enter, runs_inside
from harness.play.request_socket import ask_run
from harness.report.stories.story_file import VERBS, StoryEntries
from harness.scenario.scenario_file import in_one_line

_TIME_COMMANDS: list[tuple[re.Pattern[str], str, str | None]] = [
    (re.compile("pause"), "pause", None),
    (re.compile("go on"), "go_on", None),
    (re.compile("full speed"), "pace", None),
    (re.compile(r"speed (\d{1,9}(?:\.\d{1,9})?)"), "pace", "factor"),
    (re.compile("step"), "step", None),
    (re.compile(r"step (\d{1,9}(?:\.\d{1,9})?)(?: s)?"), "step", "seconds"),
]
"""Patterns of a user's sentences about virtual time. Each pattern has the command that the run receives, and the name
of the number in the sentence.
"""
_COMMAND_EXAMPLES = (
    "`partition 1 2 | 3`, `heal`, `1 does not reach 2 3`, `1 reaches 2 3 again`, "
    f"{', '.join(f'`{verb} 1`' for verb in VERBS)}, an entry of a timeline such as `{{loss: 0.5}}`; in virtual time "
    "`pause`, `go on`, `step`, `step 10`, `speed 20` and `full speed`"
)


def tell_command(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Directory of an active run, started with `run --by-hand`.")
    ],
    sentence: Annotated[
        list[str] | None, typer.Argument(metavar="[SENTENCE]", help="Command such as `partition 1 2 | 3` or `step 10`.")
    ] = None,
) -> None:
    """Cause an event in an active run, or control virtual time.

    Virtual time can pause, step and continue. Without SENTENCE the command prints the state of the run.
    """
    try:
        if not sentence:
            _show(asyncio.run(ask_run(run, command="state")))
            return
        for request in _parse_requests(" ".join(sentence)):
            answer = asyncio.run(ask_run(run, **request))
            typer.echo(f"{answer['at_s']:.3f} s")
    except OSError:
        raise RunDirectoryError(
            f"{run}: no active run here takes commands: start one with `ucp-harness run SCENARIO --by-hand`"
        ) from None


def _parse_requests(sentence: str) -> list[dict[str, Any]]:
    """Parse a sentence of the user, such as "speed 10". Return the requests for the run.

    Raises ScenarioError for an unknown sentence.
    """
    for pattern, command, key in _TIME_COMMANDS:
        if match := pattern.fullmatch(sentence):
            return [{"command": command, **({key: float(match[1])} if key else {})}]
    parsed = StoryEntries()
    try:
        parsed.add(0, sentence)
    except ScenarioError:
        parsed.timeline.clear()
    if not parsed.timeline:
        raise ScenarioError(f"{sentence[:80]!r} is not a command: use {_COMMAND_EXAMPLES}")
    return [
        {"command": "happen", "entry": {key: value for key, value in entry.items() if key != "at_s"}}
        for entry in parsed.timeline
    ]


def _show(state: dict[str, Any]) -> None:
    pace = "as fast as it can" if state["factor"] is None else f"{state['factor']:g} mission seconds per second"
    typer.echo(f"{state['at_s']:.3f} s, {'paused' if state['paused'] else pace}")
    for entry in state["by_hand"]:
        typer.echo(f"  {in_one_line(entry)}")
    if state["closed"] is not None:
        typer.echo(state["closed"])


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

    For example, run ping, tcpdump or ip in this shell. Without RUN the command lists the active runs.
    """
    runs, inside = running(), runs_inside()
    if run is None:
        for path, vehicles in runs.items():
            typer.echo(f"{path}: vehicles {_listed(vehicles)}")
        for path in inside:
            typer.echo(f"{path}: inside User Mode Linux")
        if not (runs or inside):
            complain("no active runs found")
        return
    directory = run.resolve()
    if directory in inside:
        arguments = ["shell", str(directory), *([] if vehicle is None else [str(vehicle)])]
        raise typer.Exit(enter(inside[directory], [*arguments, *(["--", *command] if command else [])]))
    if directory not in runs:
        raise RunDirectoryError(
            f"{run} has no running vehicles: the run has ended, or has not begun; {_active_runs_text([*runs, *inside])}"
        )
    vehicles = runs[directory]
    if vehicle is None:
        typer.echo(f"{directory}: vehicles {_listed(vehicles)}")
        return
    if vehicle not in vehicles:
        raise RunDirectoryError(f"vehicle {vehicle} of {run} has no running process: choose one of {_listed(vehicles)}")
    if shutil.which("nsenter") is None:
        raise MachineError("nsenter is not installed: install util-linux (apt install util-linux)")
    argv = command or [os.environ.get("SHELL", "/bin/sh")]
    if not command:
        complain(f"in the network of vehicle {vehicle}; `exit` leaves it, and the run continues")
    entering = enter_command(vehicles[vehicle])
    os.execvp(entering[0], [*entering, *argv])  # noqa: S606 (Ctrl-C is the shell's, and so is the exit status)


def _listed(vehicles: dict[int, int]) -> str:
    return ", ".join(map(str, vehicles))


def _active_runs_text(runs: list[Path]) -> str:
    return "no other run is active" if not runs else f"active runs: {', '.join(map(str, runs))}"
