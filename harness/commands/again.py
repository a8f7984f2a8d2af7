"""`ucp-harness again`: play once more, and say whether it is as it was; for `git bisect run`."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text
from typer.core import TyperCommand
from typer.exceptions import TyperException

from harness.commands.terminal import complain, print_json
from harness.errors import HarnessError, InterruptedRunError, MachineError
from harness.field.bisection import CannotBeTriedError, Outcome, Workshop, differences, subject_of
from harness.field.bisection.code_state import ROOT, interrupted_by_sigterm
from harness.field.bisection.outcome import read
from ucp.agent_files import write_atomically

AS_IT_WAS, CHANGED, CANNOT_BE_TRIED, STOP = 0, 1, 125, 128
"""Exit statuses as `git bisect run` takes them; from 128 on it stops."""


class MistakenError(typer.BadParameter):
    """A mistake in the arguments."""

    exit_code = STOP


class ForGitBisect(TyperCommand):
    """A mistake in the arguments says nothing of a commit, and stops the bisection."""

    def make_context(self, *arguments: Any, **options: Any) -> Any:
        try:
            return super().make_context(*arguments, **options)
        except (typer.Exit, typer.Abort):
            raise
        except TyperException as error:
            raise MistakenError(str(error), getattr(error, "ctx", None)) from None


_app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@_app.command("again", cls=ForGitBisect)
def again_command(
    subject: Annotated[
        Path, typer.Argument(metavar="SCENARIO|RUN|RECORD", help="A scenario, a run in virtual time, or field records.")
    ],
    code: Annotated[Path, typer.Option(metavar="DIR", help="The state of the code that is tried.")] = Path(),
    expect: Annotated[
        Path | None, typer.Option(metavar="OUTCOME", help="What it came to before: a file that --out has written.")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="OUTCOME", help="Keep what it comes to in this file.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of a scenario; its own first seed if not given.")] = None,
    agent: Annotated[int | None, typer.Option(metavar="ID", help="Whose record, of several; all if not given.")] = None,
    agent_command: Annotated[
        list[str] | None,
        typer.Option(help="Play as processes, with this agent; given again, each is compared with the first."),
    ] = None,
    speedup: Annotated[float | None, typer.Option(help="Of processes, instead of the scenario's.")] = None,
    limit_s: Annotated[float, typer.Option(min=1, help="What takes longer cannot be tried.")] = 600.0,
    as_json: Annotated[bool, typer.Option("--json", help="The outcome as JSON on standard output.")] = False,
) -> None:
    """Play a scenario or record once more: exit status 0 as it was, 1 changed, 125 cannot be tried, 128 stop."""
    console = Console(stderr=as_json, highlight=False)
    try:
        with interrupted_by_sigterm(), TemporaryDirectory(prefix="ucp-harness-again-") as directory:
            asked = subject_of(subject, seed, agent)
            before = read(expect) if expect is not None else None
            outcomes: list[Outcome] = []
            for number, command in enumerate(agent_command or [None]):
                plays = Path(directory) / str(number)
                plays.mkdir()
                workshop = Workshop(asked, plays, limit_s=limit_s, command=command, speedup=speedup)
                outcome, _ = workshop.play(code.resolve())
                console.print(Text(f"{command or code.resolve()}: {outcome.sentence}"), soft_wrap=True)
                outcomes.append(outcome)
    except CannotBeTriedError as error:
        complain(f"{code.resolve()} cannot be tried: {error}; --code names another state, {ROOT} is the installed one")
        raise typer.Exit(CANNOT_BE_TRIED) from None
    except InterruptedRunError:
        raise
    except HarnessError as error:
        complain(str(error))
        raise typer.Exit(STOP) from None
    if out is not None:
        _keep(out, outcomes[0])
    if as_json:
        print_json([outcome.model_dump(mode="json") for outcome in outcomes])
    changes = _changes(before, outcomes)
    for sentence in changes:
        console.print(Text(sentence), soft_wrap=True)
    if changes:
        raise typer.Exit(CHANGED)


def _changes(before: Outcome | None, outcomes: Sequence[Outcome]) -> list[str]:
    """In what they differ from what was before, or from the first; a record expects to be played as it says."""
    first, *others = outcomes
    if before is not None:
        return [sentence for outcome in outcomes for sentence in differences(before, outcome)]
    if first.of_records:
        others = list(outcomes)
        first = first.as_recorded()
    return [sentence for outcome in others for sentence in differences(first, outcome)]


def _keep(path: Path, outcome: Outcome) -> None:
    try:
        write_atomically(path, outcome.model_dump_json(indent=1) + "\n")
    except OSError as error:
        raise MachineError(f"{path} cannot be written: {error.strerror}") from None


app = typer.main.get_command(_app)
