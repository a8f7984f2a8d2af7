"""`ucp-harness replay`: what one agent saw, played again."""

import os
import sys
from bdb import BdbQuit
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness.commands.terminal import complain, print_json
from harness.errors import VIOLATED, WRONG_REQUEST, InterruptedRunError
from harness.field.replay import Player, open_record
from harness.field.replay.document import document
from harness.field.replay.names import Names
from harness.field.replay.places import Place, place
from harness.field.replay.prompt import Prompt
from harness.field.replay.summary import head, summary


def replay_command(
    record: Annotated[Path, typer.Argument(help="A trace; or a run directory, or one of field files, and --agent.")],
    agent: Annotated[int | None, typer.Option(metavar="ID", help="Whose record, if there is more than one.")] = None,
    until: Annotated[float | None, typer.Option(metavar="S", help="Play up to this mission second.")] = None,
    step: Annotated[bool, typer.Option("--step", help="Stop at the start, and ask what to do.")] = False,
    breaks: Annotated[
        list[str] | None,
        typer.Option(
            "--break", metavar="HANDLER|LINE|BLOCK", help="Stop there, and ask what to do; as often as wanted."
        ),
    ] = None,
    debug: Annotated[
        bool, typer.Option("--debug", help="At each --break call the debugger, right before the handler runs.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="What differs, as JSON on standard output.")] = False,
) -> None:
    """Feed what one agent saw into the reference core, step by step: exit status 1 if it did anything else."""
    if as_json and (step or breaks):
        raise typer.BadParameter("--json is for programs, which play the whole record: leave out --step and --break")
    if debug and not breaks:
        raise typer.BadParameter("--debug calls the debugger at each --break: name one, such as --break 812")
    opened = open_record(record, agent)
    for sentence in opened.problems:
        complain(sentence)
    console, names = Paper(highlight=False), Names(opened)
    places = [place(words, names) for words in breaks or ()]
    player = Player(opened, until)
    try:
        if not as_json:
            console.print(head(opened), soft_wrap=True)
        if debug:
            _into_debugger(player, places)
        elif step or breaks:
            prompt = Prompt(player, names, console, breaks or ())
            prompt.begin(at_start=step)
            prompt.cmdloop()
            if prompt.quit:
                raise typer.Exit(VIOLATED if player.found.deviations else 0)
        found = player.to_end()
    except (KeyboardInterrupt, BdbQuit):
        raise InterruptedRunError(f"interrupted at line {player.entry.line if player.entry else 1}") from None
    if as_json:
        print_json(document(opened, found, names))
    else:
        for line in summary(opened, found, names):
            console.print(line, soft_wrap=True)
    if found.deviations:
        raise typer.Exit(VIOLATED)
    if not found.steps:
        raise typer.Exit(WRONG_REQUEST)


def _into_debugger(player: Player, places: Sequence[Place]) -> None:
    while not player.at_end:
        upcoming = player.entries[player.position]
        player.forward(into_debugger=any(at(upcoming) for at in places))


class Paper(Console):
    """Prints on; a reader that has seen enough (`| head`) ends the printing, and nothing else."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
