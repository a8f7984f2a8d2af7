"""Implement `--kernel uml`: run the same command inside User Mode Linux, for machines without netem or root."""

import contextlib
import os
import shlex
import sys
from enum import StrEnum
from pathlib import Path

from harness.errors import MachineError
from netem import uml, uml_shell
from netem.errors import UmlError

OUT = "--out="
"""The option with which the command passes the run directory to the command inside User Mode Linux."""


class UmlKernel(StrEnum):
    host = "host"
    uml = "uml"


def run_inside(arguments: list[str]) -> int:
    """Run `ucp-harness` with these arguments in User Mode Linux, in the current directory. Return the exit status.

    Raises MachineError if User Mode Linux is missing or fails.
    """
    try:
        return uml.run(_command(arguments), cwd=Path.cwd(), env=_environment())
    except UmlError as error:
        raise MachineError(str(error)) from None


def runs_inside() -> dict[Path, Path]:
    """Return the directories of the active runs in User Mode Linux, each with the folder of its virtual machine."""
    runs: dict[Path, Path] = {}
    for folder in uml_shell.guests():
        with contextlib.suppress(OSError, ValueError):
            words = shlex.split((folder / "command").read_text().splitlines()[-1])
            runs |= {Path(word.removeprefix(OUT)): folder for word in words if word.startswith(OUT)}
    return runs


def enter(folder: Path, arguments: list[str]) -> int:
    """Run `ucp-harness` with these arguments in a running virtual machine. Return the exit status. Raises
    MachineError.
    """
    try:
        return uml_shell.enter(folder, _command(arguments), cwd=Path.cwd(), env=_environment())
    except UmlError as error:
        raise MachineError(str(error)) from None


def _command(arguments: list[str]) -> list[str]:
    return [sys.executable, "-P", "-m", "harness.cli", *arguments]


def _environment() -> dict[str, str]:
    """Return environment variables for the command inside User Mode Linux. With these variables, the command inside
    imports the same Python packages as the command outside.
    """
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": path}
