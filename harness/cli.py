"""The command line of the harness, with the list of all commands.

Exit statuses, of which `docs/reference/commands.md` has a table:

- 0: the command completed, and its result is good.
- 1: the result is bad. A check of the run has a bad verdict other than `not finished`. Or an agent under test crashed,
  hung, refused a command, or gave an invalid or irreproducible answer. Or a command
  that compares, searches or proves has a negative result: see the help of `bisect`, `conformance`, `consolidate`,
  `diff`, `doctor`, `explore`, `keys inspect`, `matrix`, `mission verify`, `prove`, `reconstruct`, `replay` and
  `validate`.
- 2: the scenario, an argument or an input file is wrong, or no input is usable.
- 3: this machine cannot do it, or an agent does not support it.
- 4: more time is needed for a result. `prove` reached a limit, or the only bad verdict of a run is `not finished`.
- 125 and 128: `bisect --once` cannot try the code, or its request is wrong. 128 also stands for an old command name.
- 130: interrupted.
"""

# ruff: noqa: E402  (an interrupt during the imports must be quiet)

import gc
import os
import signal
import sys


def _quit(signal_number: int, frame: object) -> None:
    os._exit(130)


def _interrupts_are_quiet(quiet: bool) -> None:
    """Let Ctrl-C end the process immediately while the process only imports modules, because Python would otherwise
    print a traceback of the import.

    A program that merely imports this module keeps its own handler.
    """
    handlers = (_quit, signal.default_int_handler) if quiet else (signal.default_int_handler, _quit)
    if signal.getsignal(signal.SIGINT) is handlers[1]:
        signal.signal(signal.SIGINT, handlers[0])


_IS_PROGRAM = __name__ == "__main__" or os.path.basename(sys.argv[0]) == "ucp-harness"  # noqa: PTH119  (slow)
"""True if this process is the program `ucp-harness`. False if another program imports this module."""

if _IS_PROGRAM:
    _interrupts_are_quiet(True)
    gc.disable()  # until the module of the command is imported

import codecs
import errno
import io
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from harness.errors import WRONG_REQUEST, HarnessError, InterruptedRunError, MachineError
from harness.gc_pause import gc_paused, resume_collection

MAX_NAME = 200
"""Maximum number of characters of a file name in an error."""


class CommandEntry(NamedTuple):
    """An entry in the list of commands."""

    panel: str
    """Heading of the command in the help."""
    location: str
    """The place of the command's function or group of commands, as MODULE:NAME."""
    summary: str
    """The first paragraph of the command's own help. It has at most 62 characters, so it fits into one line of a
    terminal.
    """


COMMANDS = {
    "run": CommandEntry("run", "harness.commands.run:run_command", "Play a scenario, judge it, and write a report."),
    "scenarios": CommandEntry(
        "run", "harness.commands.runs:scenarios_command", "List the scenarios that come with the harness."
    ),
    "tell": CommandEntry(
        "run", "harness.commands.tell:tell_command", "Cause an event in an active run, or control virtual time."
    ),
    "shell": CommandEntry(
        "run", "harness.commands.tell:shell_command", "Open a shell in the network of a vehicle of an active run."
    ),
    "join": CommandEntry(
        "run", "harness.commands.join:join_command", "Let an agent on this computer take part in a run elsewhere."
    ),
    "runs": CommandEntry(
        "look", "harness.commands.runs:runs_command", "List past runs with their verdicts, or open a report."
    ),
    "check": CommandEntry(
        "look",
        "harness.commands.report:check_command",
        "Judge chain exports and traces by the six characteristics.",
    ),
    "report": CommandEntry("look", "harness.commands.report:report_command", "Write the report files of a run again."),
    "watch": CommandEntry(
        "look", "harness.commands.report:watch_command", "Show a recorded run as a film in the browser."
    ),
    "chain": CommandEntry(
        "look",
        "harness.commands.chain:chain_command",
        "Print each agent's chain, or map the vehicles' positions.",
    ),
    "packets": CommandEntry(
        "look",
        "harness.commands.packets:packets_command",
        "Print each captured datagram, its receivers and its answers.",
    ),
    "diff": CommandEntry("look", "harness.commands.diff:diff_command", "Find where two runs first differ."),
    "export": CommandEntry(
        "look",
        "harness.commands.export:export_command",
        "Write a run for Foxglove, PlotJuggler, Perfetto or ROS 2.",
    ),
    "mission": CommandEntry(
        "field", "harness.commands.mission:app", "Make the mission files of a swarm, and compare them."
    ),
    "keys": CommandEntry(
        "field", "harness.commands.keys:app", "Make, distribute, inspect and revoke keys of a secure mission."
    ),
    "import": CommandEntry(
        "field", "harness.commands.import_:import_command", "Convert records of any kind into one directory."
    ),
    "consolidate": CommandEntry(
        "field",
        "harness.commands.consolidate:consolidate_command",
        "Merge the chains of all vehicles into one record.",
    ),
    "replay": CommandEntry(
        "field", "harness.commands.replay:replay_command", "Feed an agent's trace to the reference, and compare."
    ),
    "reconstruct": CommandEntry(
        "field",
        "harness.commands.reconstruct:reconstruct_command",
        "Make a scenario that reproduces a recorded flight.",
    ),
    "calibrate": CommandEntry(
        "field",
        "harness.commands.calibrate:calibrate_command",
        "Fit the radio of a scenario to the records of a flight.",
    ),
    "matrix": CommandEntry(
        "many",
        "harness.commands.matrix:matrix_command",
        "Play a scenario over loss rates, swarm sizes and many seeds.",
    ),
    "explore": CommandEntry(
        "many",
        "harness.commands.explore:explore_command",
        "Play seeds until one violates a characteristic, and shrink it.",
    ),
    "bisect": CommandEntry(
        "many", "harness.commands.bisect:app", "Find the commit that changes how a scenario or record plays."
    ),
    "prove": CommandEntry(
        "prove",
        "harness.commands.prove:prove_command",
        "Explore all states that a small swarm can reach within bounds.",
    ),
    "conformance": CommandEntry(
        "prove",
        "harness.commands.conformance:conformance_command",
        "Test one agent alone with thousands of generated cases.",
    ),
    "validate": CommandEntry(
        "prove",
        "harness.commands.coverage:validate_command",
        "Compare recorded runs with the TLA+ specification.",
    ),
    "coverage": CommandEntry(
        "prove",
        "harness.commands.coverage:coverage_command",
        "Report the share of all local states that runs reached.",
    ),
    "doctor": CommandEntry(
        "this machine",
        "harness.commands.doctor:doctor_command",
        "Report what this machine can do, and how to enable the rest.",
    ),
    "sitl": CommandEntry("this machine", "harness.commands.sitl:app", "Install and list ArduPilot's SITL binaries."),
    "clean": CommandEntry(
        "this machine", "harness.commands.doctor:clean_command", "Remove the keys and containers of killed runs."
    ),
}
"""Name of each command -> its entry, in the order of the help."""

WITH_VARIANT = ("run", "check", "replay", "coverage", "explore", "prove", "conformance")
"""Commands that play or judge agents and therefore have the option --variant. `matrix` defines its own --variant."""

OLD_NAMES = {
    "again": "`ucp-harness bisect --once`",
    "scale": "`ucp-harness matrix growth_matrix`",
}
"""Old name of a command -> the call that replaces it."""


class OldCommandNameError(HarnessError):
    """An error: the user called a command by its old name.

    `git bisect run` stops at status 128. It would interpret status 2 as a bad commit.
    """

    exit_status = 128


class LazyCommandGroup(TyperGroup):
    """The group of all commands. The module of a command is imported only when the command is called."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] in COMMANDS:
            self.add_command(load_command(args[0]), args[0])
            _interrupts_are_quiet(False)
            if _IS_PROGRAM:
                resume_collection()
        elif args and args[0] in OLD_NAMES and not ctx.resilient_parsing:
            raise OldCommandNameError(f"`{args[0]}` is now {OLD_NAMES[args[0]]}: run that")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise InterruptedRunError(f"interrupted: `{ctx.invoked_subcommand}` did not finish") from None


def load_command(name: str) -> Any:
    """Import the module of a command. Return the command, or the group of commands, with its options."""
    module, _, attribute = COMMANDS[name].location.partition(":")
    with gc_paused():
        command = getattr(import_module(module), attribute)
    if isinstance(command, TyperCommand):
        return command
    if isinstance(command, typer.Typer):
        return typer.main.get_group(command)
    single = typer.Typer(add_completion=False)
    single.command(name)(command)
    built = typer.main.get_command(single)
    if name in WITH_VARIANT:
        from harness.commands.variant_option import variant_option

        built.params.append(variant_option())
    return built


app = typer.Typer(cls=LazyCommandGroup, no_args_is_help=True, pretty_exceptions_enable=False)
for _name, _command in COMMANDS.items():
    app.command(_name, help=_command.summary, rich_help_panel=_command.panel)(lambda: None)


def _print_version(wanted: bool) -> None:
    if wanted:
        sys.stdout.write(f"ucp-harness {version('ucp-harness')}\n")
        raise typer.Exit


@app.callback()
def _harness(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Test harness for the Uniform Chain Protocol."""


ASCII_MARKS = {"✔": "+", "✘": "x"}
"""Mark of a verdict -> the mark in a terminal without Unicode. All other unknown characters become "?"."""
_ENCODING_ERRORS = "ascii-marks"


def _replace_unknown_characters(error: UnicodeError) -> tuple[str, int]:
    """Replace the characters that the terminal cannot show, as `codecs.register_error` defines."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    unknown = error.object[error.start : error.end]
    return "".join(ASCII_MARKS.get(character, "?") for character in unknown), error.end


codecs.register_error(_ENCODING_ERRORS, _replace_unknown_characters)


class _OutputWithoutBrokenPipe(io.FileIO):
    """Standard output that tolerates a reader that ends early (`| head`). The command then continues without output."""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            return memoryview(data).nbytes


def main() -> NoReturn:
    """Run the command line. A user's mistake causes a message of one sentence and an exit status, never a traceback."""
    if sys.stdout is None:  # the caller closed it
        sys.stdout = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    elif sys.stdout is (original := sys.__stdout__):
        sys.stdout = io.TextIOWrapper(
            io.BufferedWriter(_OutputWithoutBrokenPipe(original.fileno(), "w", closefd=False)),
            original.encoding,
            _ENCODING_ERRORS,
            line_buffering=original.line_buffering,
        )
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except HarnessError as error:
        _end(*error.details, str(error), exit_status=error.exit_status)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.ENAMETOOLONG) and error.filename is not None:
            _end(f"{str(error.filename)[:MAX_NAME]}: cannot be accessed: {error.strerror}", exit_status=WRONG_REQUEST)
        if error.filename is not None:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # discard the buffered output
        _end(f"standard output cannot be written: {error.strerror}", exit_status=MachineError.exit_status)
    sys.exit(0)


def _end(*sentences: str, exit_status: int) -> NoReturn:
    from harness.commands.terminal import complain

    for sentence in sentences:
        complain(sentence)
    sys.exit(exit_status)


if __name__ == "__main__":
    main()
