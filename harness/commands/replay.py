"""Implement `ucp-harness replay`, which gives an agent's recorded inputs to the reference and compares each step."""

from bdb import BdbQuit
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console
from rich.text import Text

from harness.checker.steps.core_in_use import IN_USE
from harness.checker.steps.implementation import REFERENCE
from harness.commands.terminal import complain, output, print_json
from harness.errors import VIOLATED, WRONG_REQUEST, InterruptedRunError
from harness.field.replay import RecordedTrace, RecordPlayer, ReplayResult, open_record, open_records
from harness.field.replay.breakpoints import parse_breakpoint
from harness.field.replay.prompt import ReplayPrompt
from harness.field.replay.replay_document import ReplayedRecord, document, header_text, replayed, summary
from harness.field.replay.replay_names import ReplayNames
from harness.play.core_version import edited_files


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
        typer.Option(
            "--break", metavar="HANDLER|LINE|BLOCK", help="Handler, line or block at which to stop; may be repeated."
        ),
    ] = None,
    debug: Annotated[
        bool, typer.Option("--debug", help="Call the debugger at each --break, before the handler runs.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the differences as JSON.")] = False,
) -> None:
    """Feed an agent's trace to the reference, and compare.

    Exit status 0: all steps of the agent equal those of the reference. 1: a step differs. 2: no step could be replayed.
    """
    if until is not None and not until >= 0:
        raise typer.BadParameter(f"--until {until:g} is not a mission second: use a number from 0 on")
    if as_json and (step or breaks):
        raise typer.BadParameter("--json prints the result of the whole record: leave out --step and --break")
    if debug and not breaks:
        raise typer.BadParameter("--debug calls the debugger at each --break: add one, such as --break 812")
    console = output(highlight=False)
    try:
        if step or breaks:
            _step_through(console, open_record(record, agent), until, step, breaks or [], debug)
        else:
            _play(console, open_records(record, agent), until, as_json)
    except (KeyboardInterrupt, BdbQuit):
        raise InterruptedRunError("interrupted") from None


def _play(console: Console, records: Sequence[RecordedTrace], until: float | None, as_json: bool) -> NoReturn:
    """Replay complete records, and print the differences."""
    replayed_records, differ, judged = list[ReplayedRecord](), False, False
    for sentence in dict.fromkeys(problem for record in records for problem in record.problems):
        complain(sentence)
    for record in records:
        names = ReplayNames(record)
        result = RecordPlayer(record, until).to_end()
        in_use = RecordPlayer(record, until, IN_USE).to_end()  # a debugger then stops in the handlers of `ucp`
        differ |= bool(result.deviations)
        judged |= bool(result.steps)
        if as_json:
            replayed_records.append(replayed(record, result, names))
        else:
            _show(console, [header_text(record), *summary(record, result, names), *_in_use(in_use, result)])
    if as_json:
        print_json(document(replayed_records))
    raise typer.Exit(VIOLATED if differ else 0 if judged else WRONG_REQUEST)


def _step_through(
    console: Console, record: RecordedTrace, until: float | None, at_start: bool, breaks: Sequence[str], debug: bool
) -> NoReturn:
    """Let the user step through a record with commands. After the last command, replay the remaining steps."""
    for sentence in record.problems:
        complain(sentence)
    names = ReplayNames(record)
    player = RecordPlayer(record, until, IN_USE if debug else REFERENCE)
    if debug:
        places = [parse_breakpoint(words, names) for words in breaks]
        while not player.at_end:
            upcoming = player.entries[player.position]
            player.forward(into_debugger=any(at(upcoming) for at in places))
    else:
        prompt = ReplayPrompt(player, names, console, breaks)
        _show(console, [header_text(record)])
        prompt.begin(at_start)
        prompt.cmdloop()
        if prompt.quit:
            raise typer.Exit(VIOLATED if player.result.deviations else 0)
    result = RecordPlayer(record, until).to_end()
    _show(console, [*summary(record, result, names), *_in_use(RecordPlayer(record, until, IN_USE).to_end(), result)])
    raise typer.Exit(VIOLATED if result.deviations else 0 if result.steps else WRONG_REQUEST)


def _in_use(in_use: ReplayResult, result: ReplayResult) -> list[Text]:
    """Return a warning if the installed agent core handles the recorded inputs differently from the reference.
    Otherwise return an empty list.
    """
    if [each.line for each in in_use.deviations] == [each.line for each in result.deviations]:
        return []
    edited = f", with the edited {', '.join(edited_files())}," if edited_files() else ""
    if in_use.first is None:
        return [Text(f"The core of this installation{edited} plays the record without a difference.")]
    first = in_use.first
    where = f"line {first.line}, in {first.handler}" if first.handler else f"line {first.line}"
    return [Text(f"The core of this installation{edited} first differs from the record in {where}.")]


def _show(console: Console, lines: Iterable[Text]) -> None:
    for line in lines:
        console.print(line, soft_wrap=True)
