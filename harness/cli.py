"""The command line: puts the commands together.

Exit status 0: ran, and no characteristic is violated. 1: at least one is violated, or an agent failed. 2: the request
was wrong. 3: this machine cannot do it. 130: interrupted.
"""

import sys
from typing import NoReturn

import typer

from harness.commands import sitl
from harness.commands.chain import chain_command
from harness.commands.check import check_command
from harness.commands.clean import clean_command
from harness.commands.diff import diff_command
from harness.commands.doctor import doctor_command
from harness.commands.explore import explore_command
from harness.commands.matrix import matrix_command
from harness.commands.packets import packets_command
from harness.commands.report import report_command
from harness.commands.run import run_command
from harness.commands.scale import scale_command
from harness.commands.terminal import complain
from harness.errors import HarnessError

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Test harness for the Uniform Chain Protocol.",
)
app.command("run")(run_command)
app.command("check")(check_command)
app.command("report")(report_command)
app.command("diff")(diff_command)
app.command("chain")(chain_command)
app.command("packets")(packets_command)
app.command("matrix")(matrix_command)
app.command("explore")(explore_command)
app.command("scale")(scale_command)
app.command("clean")(clean_command)
app.command("doctor")(doctor_command)
app.add_typer(sitl.app, name="sitl")


def main() -> NoReturn:
    """The console script: a user's mistake ends in one sentence and the right exit status, never in a traceback."""
    try:
        app()
    except HarnessError as error:
        complain(str(error))
        sys.exit(error.exit_status)
    sys.exit(0)


if __name__ == "__main__":
    main()
