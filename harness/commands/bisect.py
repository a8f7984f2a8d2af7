"""`ucp-harness bisect`: at which commit did it change?"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from harness.commands.terminal import print_json
from harness.field.bisection import Found, Workshop, bisect, subject_of
from harness.field.bisection.code_state import interrupted_by_sigterm

NOT_FOUND = 1
FILES_SHOWN = 12
CHANGES_SHOWN = 8


def bisect_command(
    subject: Annotated[
        Path, typer.Argument(metavar="SCENARIO|RUN|RECORD", help="A scenario, a run in virtual time, or field records.")
    ],
    good: Annotated[str, typer.Option(metavar="REV", help="A commit at which it was as it should be.")],
    bad: Annotated[str, typer.Option(metavar="REV", help="A commit at which it no longer is.")] = "HEAD",
    repository: Annotated[Path, typer.Option(metavar="DIR", help="The git repository of the commits.")] = Path(),
    seed: Annotated[int | None, typer.Option(min=0, help="Of a scenario; its own first seed if not given.")] = None,
    agent: Annotated[int | None, typer.Option(metavar="ID", help="Whose record, of several; all if not given.")] = None,
    agent_command: Annotated[
        str | None,
        typer.Option(help="Play as processes, with this agent; {code} is where the commit is checked out."),
    ] = None,
    speedup: Annotated[float | None, typer.Option(help="Of processes, instead of the scenario's.")] = None,
    limit_s: Annotated[float, typer.Option(min=1, help="A commit that takes longer cannot be tried.")] = 600.0,
    as_json: Annotated[bool, typer.Option("--json", help="What came out, as JSON on standard output.")] = False,
) -> None:
    """Play a scenario or record at commit after commit; name the first at which its outcome changes."""
    console = Console(stderr=as_json, highlight=False)
    with interrupted_by_sigterm(), TemporaryDirectory(prefix="ucp-harness-bisect-") as directory:
        asked = subject_of(subject, seed, agent)
        plays = Path(directory) / "plays"
        plays.mkdir()
        workshop = Workshop(asked, plays, limit_s=limit_s, command=agent_command, speedup=speedup)

        def tell(line: str) -> None:
            console.print(Text(line), style="dim", soft_wrap=True)

        tell(f"{asked.in_words}, between {good} and {bad}")
        found = bisect(workshop, repository.resolve(), good, bad, Path(directory), tell)
    if as_json:
        print_json(found.to_json())
    else:
        _show(console, found, good, bad)
    if len(found.first) != 1:
        raise typer.Exit(NOT_FOUND)


def _show(console: Console, found: Found, good: str, bad: str) -> None:
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
    if found.parting is not None and found.parting.first is not None:
        run = found.parting.agents[found.parting.first].run
        assert run is not None, "it is what makes it the first"
        where = " and ".join(f"{step.handler} ({step.branch})" if step else "nothing more" for step in (run.a, run.b))
        lines.append(f"the runs part first at {run.at_s:.3f} s, with agent {found.parting.first}: {where}")
    for line in lines:
        console.print(Text(line), soft_wrap=True)
