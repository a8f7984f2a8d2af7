"""The command line: which commands there are; each is imported when it is called.

Exit status 0: ran, and no characteristic is violated. 1: at least one is violated, or an agent failed. 2: the request
was wrong. 3: this machine cannot do it. 4: `prove` could not look at everything. 130: interrupted.
"""

import errno
import io
import os
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from harness.errors import WRONG_REQUEST, HarnessError, MachineError
from harness.gc_pause import gc_paused

MAX_NAME = 200
"""More of a file's name is not shown."""

COMMANDS = {
    "run": (
        "harness.commands.run:run_command",
        "Play a scenario, check the six characteristics, write a report.",
    ),
    "scenarios": (
        "harness.commands.runs:scenarios_command",
        "List the scenarios that come along: `ucp-harness run loss_15` plays one.",
    ),
    "runs": (
        "harness.commands.runs:runs_command",
        "List what was run, the newest first, with its verdict; or open a report in the browser.",
    ),
    "watch": (
        "harness.commands.watch:watch_command",
        "Show a run as a film in the browser: map, links, chains, votes and reconciles along time.",
    ),
    "tell": (
        "harness.commands.tell:tell_command",
        "Have something happen now to a run that goes on; in virtual time pause, step, go on; or see how it stands.",
    ),
    "shell": (
        "harness.commands.shell:shell_command",
        "Open a shell in the network of a vehicle whose run goes on (ping, tcpdump, ip); without one, list what runs.",
    ),
    "check": (
        "harness.commands.report:check_command",
        "Decide the six characteristics from exported chains, and from traces beside them.",
    ),
    "report": (
        "harness.commands.report:report_command",
        "Write report.html, report.md, junit.xml and chains.svg again, also of a run that was killed half-way.",
    ),
    "diff": (
        "harness.commands.diff:diff_command",
        "Say where two runs part: exit status 0 if they do not, 1 if they do.",
    ),
    "import": (
        "harness.commands.import_:import_command",
        "Bring records of any kind into one directory that `check`, `replay`, `reconstruct` and `packets` read.",
    ),
    "replay": (
        "harness.commands.replay:replay_command",
        "Feed what one agent saw into the reference core, step by step: exit status 1 if it did anything else.",
    ),
    "chain": (
        "harness.commands.chain:chain_command",
        "Print each agent's chain, block by block; or put what the vehicles logged on a map.",
    ),
    "export": (
        "harness.commands.export:export_command",
        "Write tracks, links, chains, handler runs, MAVLink and logs of a run for other tools.",
    ),
    "packets": (
        "harness.commands.packets:packets_command",
        "Print each datagram, who received it and who lost it, and what was answered to it, from a run's captures.",
    ),
    "mission": (
        "harness.commands.mission:app",
        "Make the mission files of a swarm, and compare those on its vehicles.",
    ),
    "keys": (
        "harness.commands.keys:app",
        "Make the keys of a secure mission, hand out what each vehicle gets, and take it back.",
    ),
    "consolidate": (
        "harness.commands.consolidate:consolidate_command",
        "Merge what vehicles brought home into one record: every event once, who holds what, what was lost with whom.",
    ),
    "reconstruct": (
        "harness.commands.reconstruct:reconstruct_command",
        "Make a scenario that flies what came home again, in virtual time: exit status 1, and where, if it cannot.",
    ),
    "bisect": (
        "harness.commands.bisect:bisect_command",
        "Play a scenario or record at commit after commit; name the first at which its outcome changes.",
    ),
    "again": (
        "harness.commands.again:app",
        "Play a scenario or record once more: exit status 0 as it was, 1 changed, 125 cannot be tried, 128 stop.",
    ),
    "conformance": (
        "harness.commands.conformance:conformance_command",
        "Test one agent alone, its peers played by the harness: thousands of generated cases, over UDP.",
    ),
    "matrix": (
        "harness.commands.matrix:matrix_command",
        "Play a scenario over loss rates and many seeds: figures with 95 % intervals, and what was violated.",
    ),
    "explore": (
        "harness.commands.explore:explore_command",
        "Play seed after seed in virtual time until a characteristic is violated; then find the smallest such run.",
    ),
    "coverage": (
        "harness.commands.coverage:coverage_command",
        "Say which share of all local states, inputs and branches runs have tried, of any agents that leave traces.",
    ),
    "prove": (
        "harness.commands.prove:prove_command",
        "Look at every state that the agents can come to within bounds: is any wrong, or without a way out?",
    ),
    "validate": (
        "harness.commands.validate:validate_command",
        "Hold recorded runs against the specification in TLA+, step by step: exit status 1 if an agent did otherwise.",
    ),
    "scale": (
        "harness.commands.scale:scale_command",
        "Fit how messages, bytes and time grow with agents and blocks, in the simulation; by default about 4 minutes.",
    ),
    "clean": (
        "harness.commands.doctor:clean_command",
        "Remove the containers of runs on Docker that are over; those of a run that goes on, and all others, stay.",
    ),
    "doctor": (
        "harness.commands.doctor:doctor_command",
        "Say what this machine can do, and what would let it do more; with --measure, whether it does as asked.",
    ),
    "sitl": (
        "harness.commands.sitl:app",
        "Install ArduPilot's SITL binaries, and say which there are.",
    ),
}
"""Where each is, and what it does: the first line of its own help."""


class Commands(TyperGroup):
    """All commands, of which only the one that is called is there in full."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] in COMMANDS:
            self.add_command(loaded(args[0]), args[0])
        return super().resolve_command(ctx, args)


def loaded(name: str) -> Any:
    """The command in full, or the group of commands."""
    module, _, attribute = COMMANDS[name][0].partition(":")
    with gc_paused():
        command = getattr(import_module(module), attribute)
    if isinstance(command, TyperCommand):
        return command
    if isinstance(command, typer.Typer):
        return typer.main.get_group(command)
    alone = typer.Typer(add_completion=False)
    alone.command(name)(command)
    return typer.main.get_command(alone)


app = typer.Typer(cls=Commands, no_args_is_help=True, pretty_exceptions_enable=False)
for _name, (_, _summary) in COMMANDS.items():
    app.command(_name, help=_summary)(lambda: None)


def _print_version(wanted: bool) -> None:
    if wanted:
        sys.stdout.write(f"ucp-harness {version('ucp-harness')}\n")
        raise typer.Exit


@app.callback()
def _harness(
    of_itself: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Say which version this is.")
    ] = False,
) -> None:
    """Test harness for the Uniform Chain Protocol."""


class _Output(io.FileIO):
    """Standard output. A reader that has seen enough (`| head`) ends what is printed, and nothing else."""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            return memoryview(data).nbytes


def main() -> NoReturn:
    """The console script: a user's mistake ends in one sentence and the right exit status, never in a traceback."""
    if sys.stdout is None:  # it was closed before we began: nobody wants to read
        sys.stdout = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    elif sys.stdout is (own := sys.__stdout__):
        sys.stdout = io.TextIOWrapper(
            io.BufferedWriter(_Output(own.fileno(), "w", closefd=False)),
            own.encoding,
            own.errors,
            line_buffering=own.line_buffering,
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
            _end(f"{str(error.filename)[:MAX_NAME]}: cannot be looked at: {error.strerror}", exit_status=WRONG_REQUEST)
        if error.filename is not None:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is still buffered goes nowhere
        _end(f"standard output cannot be written: {error.strerror}", exit_status=MachineError.exit_status)
    sys.exit(0)


def _end(*sentences: str, exit_status: int) -> NoReturn:
    from harness.commands.terminal import complain

    for sentence in sentences:
        complain(sentence)
    sys.exit(exit_status)


if __name__ == "__main__":
    main()
