"""`ucp-harness replay`: what one agent saw, played again."""

from bdb import BdbQuit
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console
from rich.text import Text

from harness.commands.terminal import complain, print_json
from harness.errors import VIOLATED, WRONG_REQUEST, InterruptedRunError
from harness.field.replay import Player, Record, open_record, open_records
from harness.field.replay.breakpoints import place
from harness.field.replay.prompt import Prompt
from harness.field.replay.replay_document import ReplayedRecord, document, head, replayed, summary
from harness.field.replay.replay_names import Names


def replay_command(
    record: Annotated[
        Path, typer.Argument(metavar="RECORD", help="Trace, run directory, or directory of field records.")
    ],
    agent: Annotated[
        int | None, typer.Option(metavar="ID", help="Agent whose trace to replay; all agents if not given.")
    ] = None,
    until: Annotated[float | None, typer.Option(metavar="S", help="Stop at this mission second.")] = None,
    step: Annotated[bool, typer.Option("--step", help="Stop at the first step, and read commands.")] = False,
    breaks: Annotated[
        list[str] | None,
        typer.Option("--break", metavar="HANDLER|LINE|BLOCK", help="Stop there, and read commands; may be repeated."),
    ] = None,
    debug: Annotated[
        bool, typer.Option("--debug", help="Call the debugger at each --break, before the handler runs.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the differences as JSON.")] = False,
) -> None:
    """Feed an agent's trace to the reference core, and compare.

    Exit status 0: the agent did the same as the core. 1: it did not. 2: no step could be replayed.
    """
    if until is not None and not until >= 0:
        raise typer.BadParameter(f"--until {until:g} is no mission second: it is 0 or more")
    if as_json and (step or breaks):
        raise typer.BadParameter("--json is for programs, which play the whole record: leave out --step and --break")
    if debug and not breaks:
        raise typer.BadParameter("--debug calls the debugger at each --break: name one, such as --break 812")
    console = Console(highlight=False)
    try:
        if step or breaks:
            _ask(console, open_record(record, agent), until, step, breaks or [], debug)
        else:
            _play(console, open_records(record, agent), until, as_json)
    except (KeyboardInterrupt, BdbQuit):
        raise InterruptedRunError("interrupted") from None


def _play(console: Console, records: Sequence[Record], until: float | None, as_json: bool) -> NoReturn:
    """Play whole records, and say what differs."""
    told, differ, judged = list[ReplayedRecord](), False, False
    for record in records:
        _complain_of(record)
        player, names = Player(record, until), Names(record)
        found = player.to_end()
        differ |= bool(found.deviations)
        judged |= bool(found.steps)
        if as_json:
            told.append(replayed(record, found, names))
        else:
            _show(console, [head(record), *summary(record, found, names)])
    if as_json:
        print_json(document(told))
    raise typer.Exit(VIOLATED if differ else 0 if judged else WRONG_REQUEST)


def _ask(
    console: Console, record: Record, until: float | None, at_start: bool, breaks: Sequence[str], debug: bool
) -> NoReturn:
    """Step through a record as the user says; when no more is said, play the rest."""
    _complain_of(record)
    player, names = Player(record, until), Names(record)
    if debug:
        places = [place(words, names) for words in breaks]
        while not player.at_end:
            upcoming = player.entries[player.position]
            player.forward(into_debugger=any(at(upcoming) for at in places))
    else:
        prompt = Prompt(player, names, console, breaks)
        _show(console, [head(record)])
        prompt.begin(at_start)
        prompt.cmdloop()
        if prompt.quit:
            raise typer.Exit(VIOLATED if player.found.deviations else 0)
    found = player.to_end()
    _show(console, summary(record, found, names))
    raise typer.Exit(VIOLATED if found.deviations else 0 if found.steps else WRONG_REQUEST)


def _complain_of(record: Record) -> None:
    for sentence in record.problems:
        complain(sentence)


def _show(console: Console, lines: Iterable[Text]) -> None:
    for line in lines:
        console.print(line, soft_wrap=True)
