"""`ucp-harness tell`: have something happen to a run that goes on, or have virtual time stand still."""

import asyncio
import re
from pathlib import Path
from typing import Annotated, Any

import typer

from harness.errors import RunDirectoryError, ScenarioError
from harness.play.request_socket import ask_run
from harness.report.stories.sentences import VERBS, Course
from harness.scenario.scenario_file import in_a_line

_TIME: list[tuple[re.Pattern[str], str, str | None]] = [
    (re.compile("pause"), "pause", None),
    (re.compile("go on"), "go_on", None),
    (re.compile("full speed"), "pace", None),
    (re.compile(r"speed (\d{1,9}(?:\.\d{1,9})?)"), "pace", "factor"),
    (re.compile("step"), "step", None),
    (re.compile(r"step (\d{1,9}(?:\.\d{1,9})?)(?: s)?"), "step", "seconds"),
]
"""What is said of time, the command that it is, and what its number stands for."""
_WHAT_THERE_IS = (
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

    Virtual time can pause, step and go on. Without SENTENCE the command prints the state of the run.
    """
    try:
        if not sentence:
            _show(asyncio.run(ask_run(run, command="state")))
            return
        for request in _requests(" ".join(sentence)):
            answer = asyncio.run(ask_run(run, **request))
            typer.echo(f"{answer['at_s']:.3f} s")
    except OSError:
        raise RunDirectoryError(
            f"{run}: no run goes on there that can be told anything: start it with `ucp-harness run SCENARIO --by-hand`"
        ) from None


def _requests(sentence: str) -> list[dict[str, Any]]:
    """What is to be asked of the run. Raises ScenarioError if nothing of the kind can be."""
    for pattern, command, key in _TIME:
        if said := pattern.fullmatch(sentence):
            return [{"command": command, **({key: float(said[1])} if key else {})}]
    course = Course()
    try:
        course.tell(0, sentence)
    except ScenarioError:
        course.timeline.clear()
    if not course.timeline:
        raise ScenarioError(f"{sentence[:80]!r} is nothing that a run can be told: there are {_WHAT_THERE_IS}")
    return [
        {"command": "happen", "entry": {key: value for key, value in entry.items() if key != "at_s"}}
        for entry in course.timeline
    ]


def _show(state: dict[str, Any]) -> None:
    pace = "as fast as it can" if state["factor"] is None else f"{state['factor']:g} mission seconds a second"
    typer.echo(f"{state['at_s']:.3f} s, {'paused' if state['paused'] else pace}")
    for entry in state["by_hand"]:
        typer.echo(f"  {in_a_line(entry)}")
    if state["closed"] is not None:
        typer.echo(state["closed"])
