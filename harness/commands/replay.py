"""`ucp-harness replay`: what one agent saw, played again."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness.commands.terminal import complain, print_json
from harness.errors import VIOLATED, WRONG_REQUEST
from harness.field.replay import Player, open_record
from harness.field.replay.document import document
from harness.field.replay.names import Names
from harness.field.replay.summary import head, summary


def replay_command(
    record: Annotated[Path, typer.Argument(help="A trace; or a run directory, or one of field files, and --agent.")],
    agent: Annotated[int | None, typer.Option(metavar="ID", help="Whose record, if there is more than one.")] = None,
    until: Annotated[float | None, typer.Option(metavar="S", help="Play up to this mission second.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="What differs, as JSON on standard output.")] = False,
) -> None:
    """Feed what one agent saw into the reference core, step by step: exit status 1 if it did anything else."""
    opened = open_record(record, agent)
    for sentence in opened.problems:
        complain(sentence)
    player, names = Player(opened, until), Names(opened)
    found = player.to_end()
    if as_json:
        print_json(document(opened, found, names))
    else:
        console = Console(highlight=False)
        console.print(head(opened), soft_wrap=True)
        for line in summary(opened, found, names):
            console.print(line, soft_wrap=True)
    if found.deviations:
        raise typer.Exit(VIOLATED)
    if not found.steps:
        raise typer.Exit(WRONG_REQUEST)
