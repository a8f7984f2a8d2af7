"""Implement `ucp-harness bisect`, which finds the commit that changes a result, or tests one state of the code."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text
from typer.core import TyperCommand
from typer.exceptions import TyperException

from harness.commands._shared_options import RARE, complete_scenario
from harness.commands.terminal import complain, output, print_json
from harness.errors import HarnessError, InterruptedRunError, MachineError
from harness.field.bisection import (
    BisectionResult,
    Outcome,
    SubjectPlayer,
    UntestableError,
    bisect,
    differences,
    subject_of,
)
from harness.field.bisection.outcome import read
from harness.run.code_state import ROOT, interrupted_by_sigterm
from ucp.agent_files import write_atomically

NOT_FOUND = 1
CHANGED, UNTESTABLE, WRONG_ONCE_REQUEST = 1, 125, 128
"""Exit statuses of `bisect --once`, as `git bisect run` defines them. `git bisect run` stops at a status of 128 or
above.
"""
FILES_SHOWN = 12
CHANGES_SHOWN = 8
ONCE = "With --once"


class OnceUsageError(typer.BadParameter):
    """An error: the arguments for the option --once are wrong."""

    exit_code = WRONG_ONCE_REQUEST


class BisectCommand(TyperCommand):
    """The command `bisect`. With the option --once, wrong arguments cause exit status 128, at which `git bisect run`
    stops.
    """

    def make_context(self, info_name: str | None, args: list[str], *rest: Any, **options: Any) -> Any:
        once = "--once" in args
        try:
            return super().make_context(info_name, args, *rest, **options)
        except (typer.Exit, typer.Abort):
            raise
        except TyperException as error:
            if not once:
                raise
            raise OnceUsageError(str(error), getattr(error, "ctx", None)) from None


_app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@_app.command("bisect", cls=BisectCommand)
def bisect_command(
    subject: Annotated[
        Path,
        typer.Argument(
            metavar="SCENARIO|RUN|RECORD",
            help="Scenario, run in virtual time, or field records.",
            autocompletion=complete_scenario,
        ),
    ],
    good: Annotated[str | None, typer.Option(metavar="REV", help="Commit with the expected outcome.")] = None,
    bad: Annotated[str, typer.Option(metavar="REV", help="Commit with the changed outcome.")] = "HEAD",
    repository: Annotated[
        Path, typer.Option(metavar="DIR", help="Git repository; with --once any directory with the code.")
    ] = Path(),
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of a scenario; its first seed if not given.")] = None,
    agent: Annotated[
        int | None, typer.Option(metavar="ID", help="Agent whose record to play; all agents if not given.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    once: Annotated[
        bool,
        typer.Option("--once", rich_help_panel=ONCE, help="Test only the code in --repository, for `git bisect run`."),
    ] = False,
    expect: Annotated[
        Path | None,
        typer.Option(metavar="OUTCOME", rich_help_panel=ONCE, help="Outcome to compare with, written by --out."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="OUTCOME", rich_help_panel=ONCE, help="Write the outcome to this file.")
    ] = None,
    agent_command: Annotated[
        list[str] | None,
        typer.Option(
            rich_help_panel=RARE,
            help="Play processes of this agent; {code} stands for the code directory.",
        ),
    ] = None,
    speedup: Annotated[
        float | None, typer.Option(rich_help_panel=RARE, help="Speedup of processes, instead of the scenario's.")
    ] = None,
    limit_s: Annotated[
        float, typer.Option(min=1, rich_help_panel=RARE, help="Seconds after which a commit is given up and skipped.")
    ] = 600.0,
) -> None:
    """Find the commit that changes how a scenario or record plays.

    Exit status 0: the commit is found. 1: the good and the bad commit have the same outcome, or the remaining commits
    cannot be tested. 2: an argument is wrong, or the repository cannot be read. 3: this machine cannot play the
    subject.

    With --once, the command tries the code in --repository. Exit status 0: the outcome is as expected (for records: as
    recorded). 1: the outcome changed. 125: this code cannot be tested. 128: an argument is wrong.
    """
    request = _PlayRequest(subject, seed, agent, agent_command or [None], speedup, limit_s)
    console = output(stderr=as_json, highlight=False)
    if once:
        if good is not None:
            raise OnceUsageError(
                "--good and --once exclude each other: --good starts a search, --once tries one state of the code"
            )
        _try_once(console, request, repository.resolve(), expect, out, as_json)
    elif good is None:
        raise typer.BadParameter(
            "bisect needs a commit with the expected outcome (--good), or --once to try one state of the code"
        )
    elif expect is not None or out is not None or len(request.commands) > 1:
        raise typer.BadParameter(
            "--expect, --out and several --agent-command need --once: add --once, or leave them out"
        )
    else:
        _search(console, request, repository.resolve(), good, bad, as_json)


@dataclass(frozen=True)
class _PlayRequest:
    """The scenario or record to play, with the options that decide how to play it."""

    subject: Path
    seed: int | None
    agent: int | None
    commands: Sequence[str | None]
    speedup: float | None
    limit_s: float

    def workshops(self, directory: Path) -> list[SubjectPlayer]:
        """Return one player for each agent command. Each player plays the scenario or the record. Raises
        HarnessError.
        """
        subject = subject_of(self.subject, self.seed, self.agent)
        workshops = []
        for number, command in enumerate(self.commands):
            plays = directory / f"plays-{number}"
            plays.mkdir()
            workshops.append(SubjectPlayer(subject, plays, limit_s=self.limit_s, command=command, speedup=self.speedup))
        return workshops


def _search(console: Console, request: _PlayRequest, repository: Path, good: str, bad: str, as_json: bool) -> None:
    with interrupted_by_sigterm(), TemporaryDirectory(prefix="ucp-harness-bisect-") as directory:
        (workshop,) = request.workshops(Path(directory))

        def print_progress(line: str) -> None:
            console.print(Text(line), style="dim", soft_wrap=True)

        print_progress(f"{workshop.subject.in_words}, between {good} and {bad}")
        found = bisect(workshop, repository, good, bad, Path(directory), print_progress)
    if as_json:
        print_json(found.to_json())
    else:
        _show(console, found, good, bad)
    if len(found.first) != 1:
        raise typer.Exit(NOT_FOUND)


def _try_once(
    console: Console, request: _PlayRequest, code: Path, expect: Path | None, out: Path | None, as_json: bool
) -> None:
    outcomes: list[Outcome] = []
    try:
        with interrupted_by_sigterm(), TemporaryDirectory(prefix="ucp-harness-bisect-") as directory:
            workshops = request.workshops(Path(directory))
            of_records = workshops[0].subject.scenario is None
            before = read(expect) if expect is not None else None
            for command, workshop in zip(request.commands, workshops, strict=True):
                outcome, _ = workshop.play(code)
                console.print(Text(f"{command or code}: {outcome.sentence}"), soft_wrap=True)
                outcomes.append(outcome)
    except UntestableError as error:
        is_no_repository = None in request.commands and not (code / "ucp").is_dir()
        hint = f"; name the repository with --repository (the installed code is in {ROOT})" if is_no_repository else ""
        complain(f"{code} cannot be tried: {error}{hint}")
        raise typer.Exit(UNTESTABLE) from None
    except InterruptedRunError:
        raise
    except HarnessError as error:
        complain(str(error))
        raise typer.Exit(WRONG_ONCE_REQUEST) from None
    if out is not None:
        _keep(out, outcomes[0])
    if as_json:
        print_json([outcome.model_dump(mode="json") for outcome in outcomes])
    changes = _changes(before, outcomes, of_records)
    for sentence in changes:
        console.print(Text(sentence), soft_wrap=True)
    if changes:
        raise typer.Exit(CHANGED)


def _changes(before: Outcome | None, outcomes: Sequence[Outcome], of_records: bool) -> list[str]:
    """Return the differences between the outcomes and the expected outcome. Without an expected outcome, compare with
    the record or with the first outcome.
    """
    if before is not None:
        return [sentence for outcome in outcomes for sentence in differences(before, outcome)]
    if of_records:
        return [sentence for outcome in outcomes for sentence in differences(outcome.as_recorded(), outcome)]
    first, *others = outcomes
    return [sentence for outcome in others for sentence in differences(first, outcome)]


def _keep(path: Path, outcome: Outcome) -> None:
    try:
        write_atomically(path, outcome.model_dump_json(indent=1) + "\n")
    except OSError as error:
        raise MachineError(f"{path} cannot be written: {error.strerror}") from None


def _show(console: Console, found: BisectionResult, good: str, bad: str) -> None:
    lines: list[str] = []
    if not found.first:
        lines.append(f"the outcome at {bad} is that at {good}: {found.bad.sentence}")
    elif len(found.first) > 1:
        lines.append(f"the outcome changes at one of these {len(found.first)} commits, of which all but the last ")
        lines[-1] += "cannot be tried:"
        lines += [f"  {commit.sentence}" for commit in found.first]
    else:
        (first,) = found.first
        lines.append(f"the outcome changes at {first.sentence}")
        lines += [f"  it changes {file}" for file in first.files[:FILES_SHOWN]]
        if len(first.files) > FILES_SHOWN:
            lines.append(f"  and {len(first.files) - FILES_SHOWN} more files")
    lines += found.changes[:CHANGES_SHOWN]
    if len(found.changes) > CHANGES_SHOWN:
        lines.append(f"and {len(found.changes) - CHANGES_SHOWN} more; --json has all")
    if found.first_difference is not None and found.first_difference.first is not None:
        run = found.first_difference.agents[found.first_difference.first].run
        assert run is not None, "it is what makes it the first"
        where = " and ".join(f"{step.handler} ({step.branch})" if step else "nothing more" for step in (run.a, run.b))
        lines.append(f"the runs differ first at {run.at_s:.3f} s, at agent {found.first_difference.first}: {where}")
    for line in lines:
        console.print(Text(line), soft_wrap=True)


app = typer.main.get_command(_app)
