"""The commands of whoever steps through a record: forward and back, by step, handler, block, line and second."""

import cmd
import sys
from bdb import BdbQuit
from collections.abc import Callable, Sequence
from contextlib import suppress

from rich.console import Console, RenderableType

from harness.checker.steps.core_in_use import IN_USE
from harness.errors import FieldError
from harness.field.replay._agent_record import Entry
from harness.field.replay._other_agents import Others
from harness.field.replay._player import Player
from harness.field.replay._step_text import Words
from harness.field.replay.breakpoints import Place, next_place, place
from harness.field.replay.replay_names import Names

AROUND = 5
"""Lines that `list` shows before and after."""
SHORT = {
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


class Prompt(cmd.Cmd):
    """Reads commands from standard input until it ends, or `quit`; `ended` says which of these.

    `breaks` are where `continue` stops, besides differences.
    """

    identchars = cmd.Cmd.identchars + "-"

    def __init__(self, player: Player, names: Names, console: Console, breaks: Sequence[str]) -> None:
        self._terminal = sys.stdin.isatty()
        super().__init__()
        self.use_rawinput = self._terminal
        self.quit = False
        self._player = player
        self._names = names
        self._console = console
        self._breaks: dict[str, Place] = {words: place(words, names) for words in breaks}
        self._words = Words(player, names)
        self._others = Others(player.record)

    def begin(self, at_start: bool) -> None:
        """Show the beginning of the record, or go on to the first break."""
        self._show()
        if not at_start:
            self.do_continue("")

    # What cmd.Cmd asks for

    @property
    def prompt(self) -> str:  # type: ignore[override]
        return f"(replay {self._player.position}/{len(self._player.entries)}) " if self._terminal else ""

    def onecmd(self, line: str) -> bool:
        """Run a command; a short form or the beginning of a name will do. An empty line is the last command again."""
        name, argument, _ = self.parseline(line)
        if line == "EOF":
            if self._terminal:
                self._console.print()
            return True
        if not line.strip():
            return self.emptyline()
        if not self._terminal:
            self._console.print(f"> {line.strip()[:60]}", style="dim", markup=False)
        name = SHORT.get(name or line.strip(), name or "")
        known = {command.removeprefix("do_").replace("_", "-") for command in self.get_names() if command[:3] == "do_"}
        meant = [command for command in sorted(known) if command.startswith(name)]
        if name not in known and len(meant) != 1:
            self._say(f"no command {line.strip()[:60]!r}; help lists the commands")
            return False
        self.lastcmd = line
        run: Callable[[str], bool | None] = getattr(
            self, f"do_{(name if name in known else meant[0]).replace('-', '_')}"
        )
        try:
            return bool(run((argument or "").strip()))
        except FieldError as error:
            self._say(str(error))
            return False

    def do_help(self, arg: str) -> None:
        """help: this"""
        for name in self.get_names():
            if name.startswith("do_"):
                self._console.print(f"  {(getattr(self, name).__doc__ or '').strip()}", soft_wrap=True)

    # Going

    def do_next(self, arg: str) -> None:
        """next [N | HANDLER | BLOCK | difference] (n): play the next step, N steps, or up to the next there"""
        self._go(arg, backward=False)

    def do_back(self, arg: str) -> None:
        """back [N | HANDLER | BLOCK | difference] (b): the same backward"""
        self._go(arg, backward=True)

    def do_continue(self, arg: str) -> None:
        """continue (c): play up to the next break or difference, or to the end"""
        player = self._player
        while not player.at_end:
            if self._stops_at(player.forward()):
                break
        self._show()

    def do_reverse_continue(self, arg: str) -> None:
        """reverse-continue (rc): go back to the break or difference before, or to the start"""
        player, differing = self._player, {*self._player.found.positions}
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

    # Stopping

    def do_break(self, arg: str) -> None:
        """break [HANDLER | LINE | BLOCK]: let `continue` stop there; without anything, show where it does"""
        if arg:
            self._breaks[arg] = place(arg, self._names)
        self._say("stops at differences" + "".join(f", {words}" for words in self._breaks))

    def do_clear(self, arg: str) -> None:
        """clear HANDLER | LINE | BLOCK: do not stop there any more"""
        if self._breaks.pop(arg, None) is None:
            self._say(f"no breakpoint at {arg[:60]!r}")

    def do_debug(self, arg: str) -> None:
        """debug (d): play this step once more in the debugger, pdb or the IDE's; `step` from there is in its handler"""
        player = self._player
        if not player.position:
            raise FieldError("nothing is played yet: enter next, then debug")
        in_use = Player(player.record, implementation=IN_USE)
        in_use.to(player.position - 1)
        with suppress(BdbQuit):
            in_use.forward(into_debugger=True)
        self._show()

    # Looking

    def do_state(self, arg: str) -> None:
        """state (s): all that the agent holds, asks and counts after this step"""
        self._print(*self._words.state())

    def do_why(self, arg: str) -> None:
        """why (w): this step again: what triggered it, what the algorithm says, what came of it"""
        self._show()

    def do_compare(self, arg: str) -> None:
        """compare: the agent's own record of this step beside what the reference does"""
        deviations = self._player.deviations_here()
        if not deviations:
            self._say("no difference here: the record equals the reference")
        for deviation in deviations:
            self._print(self._words.beside(deviation))

    def do_others(self, arg: str) -> None:
        """others (o): what the other agents did at this moment, and who heard what this one sent"""
        with self._console.status("reading the records of other agents"):
            shown = [*self._others.at(self._player)]
        self._print(*shown)

    def do_list(self, arg: str) -> None:
        """list (l): the lines around this one"""
        player = self._player
        first = max(0, player.position - 1 - AROUND)
        for number, entry in enumerate(player.entries[first : player.position + AROUND], first + 1):
            mark = "→" if number == player.position else " "
            self._print(self._words.line(number, entry), before=mark)

    def do_quit(self, arg: str) -> bool:
        """quit (q): end here"""
        self.quit = True
        return True

    # How

    def _go(self, arg: str, backward: bool) -> None:
        player = self._player
        if not arg or arg.isdigit():
            steps = int(arg or 1)
            if (player.position == 0) if backward else player.at_end:
                self._say("start of the record" if backward else "end of the record")
                return
            player.to(player.position + (-steps if backward else steps))
        elif "difference".startswith(arg):
            self._go_to_difference(backward)
            return
        else:
            position = next_place(player, place(arg, self._names), backward)
            if position is None:
                self._say(f"there is no {arg[:60]} {'before' if backward else 'after'} this")
                return
            player.to(position)
        self._show()

    def _go_to_difference(self, backward: bool) -> None:
        player = self._player
        positions = player.found.positions
        if backward:
            earlier = [position for position in positions if position < player.position]
            if not earlier:
                self._say("no difference before this step")
                return
            player.to(earlier[-1])
        else:
            known = len(positions)
            while not player.at_end and len(player.found.positions) == known:
                player.forward()
            if len(player.found.positions) == known:
                self._say("no difference after this step")
        self._show()

    def _stops_at(self, entry: Entry) -> bool:
        """Whether `continue` stops at the entry played last."""
        positions = self._player.found.positions
        return positions[-1:] == [self._player.position] or self._breaks_at(entry)

    def _breaks_at(self, entry: Entry) -> bool:
        return any(at(entry) for at in self._breaks.values())

    def _show(self) -> None:
        self._print(*self._words.step(), self._words.in_short())

    def _say(self, words: str) -> None:
        self._console.print(words, style="yellow", soft_wrap=True, markup=False)

    def _print(self, *lines: RenderableType, before: str = "") -> None:
        for line in lines:
            if before:
                self._console.print(before, end="")
            self._console.print(line, soft_wrap=True)
