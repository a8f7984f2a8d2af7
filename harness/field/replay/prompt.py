"""Provide the command line of a replay. Its commands go forward and back by step, handler, block, line and second."""

import cmd
import sys
from bdb import BdbQuit
from collections.abc import Callable, Sequence
from contextlib import suppress

from rich.console import Console, RenderableType

from harness.checker.steps.core_in_use import IN_USE
from harness.errors import FieldError
from harness.field.replay._agent_record import RecordEntry
from harness.field.replay._other_agents import OtherAgents
from harness.field.replay._player import RecordPlayer
from harness.field.replay._step_text import StepText
from harness.field.replay.breakpoints import Breakpoint, next_stop, parse_breakpoint
from harness.field.replay.replay_names import ReplayNames

LINES_AROUND = 5
"""Number of lines that the command `list` shows before and after the current one."""
SHORT_FORMS = {
    "n": "next",
    "b": "back",
    "c": "continue",
    "rc": "reverse-continue",
    "g": "goto",
    "s": "state",
    "w": "why",
    "o": "others",
    "l": "list",
    "d": "debug",
    "q": "quit",
    "?": "help",
}


class ReplayPrompt(cmd.Cmd):
    """A command line that reads commands until the input ends or the user enters `quit`. `breaks` are the breakpoints.
    The command `continue` stops at these breakpoints and at differences.
    """

    identchars = cmd.Cmd.identchars + "-"

    def __init__(self, player: RecordPlayer, names: ReplayNames, console: Console, breaks: Sequence[str]) -> None:
        self._terminal = sys.stdin.isatty()
        super().__init__()
        self.use_rawinput = self._terminal
        self.quit = False
        self._player = player
        self._names = names
        self._console = console
        self._breakpoints: dict[str, Breakpoint] = {text: parse_breakpoint(text, names) for text in breaks}
        self._text = StepText(player, names)
        self._other_agents = OtherAgents(player.record)

    def begin(self, at_start: bool) -> None:
        """Show the beginning of the record. If `at_start` is false, go to the first breakpoint instead."""
        self._show()
        if not at_start:
            self.do_continue("")

    # Overridden members of cmd.Cmd

    @property
    def prompt(self) -> str:  # type: ignore[override]
        return f"(replay {self._player.position}/{len(self._player.entries)}) " if self._terminal else ""

    def onecmd(self, line: str) -> bool:
        """Execute a command. Return true if the replay must end.

        The user may enter short forms and unique beginnings of command names. An empty line repeats the last command.
        """
        name, argument, _ = self.parseline(line)
        if line == "EOF":
            if self._terminal:
                self._console.print()
            return True
        if not line.strip():
            return self.emptyline()
        if not self._terminal:
            self._console.print(f"> {line.strip()[:60]}", style="dim", markup=False)
        name = SHORT_FORMS.get(name or line.strip(), name or "")
        names = {command.removeprefix("do_").replace("_", "-") for command in self.get_names() if command[:3] == "do_"}
        matching = [command for command in sorted(names) if command.startswith(name)]
        if name not in names and len(matching) != 1:
            self._print_message(f"{line.strip()[:60]!r} is not a command; help lists the commands")
            return False
        self.lastcmd = line
        run: Callable[[str], bool | None] = getattr(
            self, f"do_{(name if name in names else matching[0]).replace('-', '_')}"
        )
        try:
            return bool(run((argument or "").strip()))
        except FieldError as error:
            self._print_message(str(error))
            return False

    def do_help(self, arg: str) -> None:
        """help: list the commands"""
        for name in self.get_names():
            if name.startswith("do_"):
                self._console.print(f"  {(getattr(self, name).__doc__ or '').strip()}", soft_wrap=True)

    # Commands that move

    def do_next(self, arg: str) -> None:
        """next [N | HANDLER | BLOCK | difference] (n): play one step, N steps, or up to the next such step"""
        self._go(arg, backward=False)

    def do_back(self, arg: str) -> None:
        """back [N | HANDLER | BLOCK | difference] (b): go back one step, N steps, or to the previous such step"""
        self._go(arg, backward=True)

    def do_continue(self, arg: str) -> None:
        """continue (c): play up to the next breakpoint or difference, or to the end"""
        player = self._player
        while not player.at_end:
            if self._stops_at(player.forward()):
                break
        self._show()

    def do_reverse_continue(self, arg: str) -> None:
        """reverse-continue (rc): go back to the previous breakpoint or difference, or to the start"""
        player, differing = self._player, {*self._player.result.positions}
        earlier = next(
            (
                at
                for at in range(player.position - 1, 0, -1)
                if at in differing or self._breaks_at(player.entries[at - 1])
            ),
            0,
        )
        player.to(earlier)
        self._show()

    def do_goto(self, arg: str) -> None:
        """goto LINE | SECONDs | start | end (g): "goto 812" is a line of the record, "goto 300s" a mission second"""
        record, player = self._player.record, self._player
        if arg in ("start", "end"):
            player.to(0 if arg == "start" else len(player.entries))
        elif arg.isdigit():
            player.to(record.position_of_line(int(arg) + 1))
        else:
            try:
                at_s = float(arg.removesuffix("s"))
            except ValueError:
                raise FieldError('goto needs a line ("goto 812"), a second ("goto 300s"), start or end') from None
            player.to(record.position_of_second(at_s))
        self._show()

    # Commands for breakpoints

    def do_break(self, arg: str) -> None:
        """break [HANDLER | LINE | BLOCK]: let `continue` stop there; without an argument, list the breakpoints"""
        if arg:
            self._breakpoints[arg] = parse_breakpoint(arg, self._names)
        self._print_message("stops at differences" + "".join(f", {text}" for text in self._breakpoints))

    def do_clear(self, arg: str) -> None:
        """clear HANDLER | LINE | BLOCK: remove the breakpoint"""
        if self._breakpoints.pop(arg, None) is None:
            self._print_message(f"no breakpoint at {arg[:60]!r}")

    def do_debug(self, arg: str) -> None:
        """debug (d): play this step again in the debugger (pdb or that of your IDE); `step` enters the handler"""
        player = self._player
        if not player.position:
            raise FieldError("no step is played yet: enter next, then debug")
        in_use = RecordPlayer(player.record, implementation=IN_USE)
        in_use.to(player.position - 1)
        with suppress(BdbQuit):
            in_use.forward(into_debugger=True)
        self._show()

    # Commands that show

    def do_state(self, arg: str) -> None:
        """state (s): show the complete state of the agent after this step"""
        self._print(*self._text.state())

    def do_why(self, arg: str) -> None:
        """why (w): show this step again: its cause, the rule of its Algorithm, and its effects"""
        self._show()

    def do_compare(self, arg: str) -> None:
        """compare: show the recorded step and the step of the reference side by side"""
        deviations = self._player.deviations_here()
        if not deviations:
            self._print_message("no difference here: the record equals the reference")
        for deviation in deviations:
            self._print(self._text.side_by_side(deviation))

    def do_others(self, arg: str) -> None:
        """others (o): show the steps of the other agents at this moment, and the receivers of this step's messages"""
        with self._console.status("reading the records of other agents"):
            shown = [*self._other_agents.at(self._player)]
        self._print(*shown)

    def do_list(self, arg: str) -> None:
        """list (l): show the lines before and after this one"""
        player = self._player
        first = max(0, player.position - 1 - LINES_AROUND)
        for number, entry in enumerate(player.entries[first : player.position + LINES_AROUND], first + 1):
            mark = "→" if number == player.position else " "
            self._print(self._text.line(number, entry), before=mark)

    def do_quit(self, arg: str) -> bool:
        """quit (q): end the replay"""
        self.quit = True
        return True

    # Helpers

    def _go(self, arg: str, backward: bool) -> None:
        player = self._player
        if not arg or arg.isdigit():
            steps = int(arg or 1)
            if (player.position == 0) if backward else player.at_end:
                self._print_message("start of the record" if backward else "end of the record")
                return
            player.to(player.position + (-steps if backward else steps))
        elif "difference".startswith(arg):
            self._go_to_difference(backward)
            return
        else:
            position = next_stop(player, parse_breakpoint(arg, self._names), backward)
            if position is None:
                self._print_message(f"there is no {arg[:60]} {'before' if backward else 'after'} this step")
                return
            player.to(position)
        self._show()

    def _go_to_difference(self, backward: bool) -> None:
        player = self._player
        positions = player.result.positions
        if backward:
            earlier = [position for position in positions if position < player.position]
            if not earlier:
                self._print_message("no difference before this step")
                return
            player.to(earlier[-1])
        else:
            names = len(positions)
            while not player.at_end and len(player.result.positions) == names:
                player.forward()
            if len(player.result.positions) == names:
                self._print_message("no difference after this step")
        self._show()

    def _stops_at(self, entry: RecordEntry) -> bool:
        """Return true if the command `continue` must stop at the last played entry."""
        positions = self._player.result.positions
        return positions[-1:] == [self._player.position] or self._breaks_at(entry)

    def _breaks_at(self, entry: RecordEntry) -> bool:
        return any(at(entry) for at in self._breakpoints.values())

    def _show(self) -> None:
        self._print(*self._text.step(), self._text.in_short())

    def _print_message(self, text: str) -> None:
        self._console.print(text, style="yellow", soft_wrap=True, markup=False)

    def _print(self, *lines: RenderableType, before: str = "") -> None:
        for line in lines:
            if before:
                self._console.print(before, end="")
            self._console.print(line, soft_wrap=True)
