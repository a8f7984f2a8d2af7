"""`--kernel uml`: the same command line in User Mode Linux, for machines without netem, or without any privilege."""

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
"""How a run that is played inside is told its directory."""


class Kernel(StrEnum):
    host = "host"
    uml = "uml"


def run_inside(arguments: list[str]) -> int:
    """Run `ucp-harness` with these arguments in User Mode Linux, from where we are; its exit status.

    Raises MachineError if User Mode Linux is not here, or fails.
    """
    try:
        return uml.run(_command(arguments), cwd=Path.cwd(), env=_environment())
    except UmlError as error:
        raise MachineError(str(error)) from None


def runs_inside() -> dict[Path, Path]:
    """The directories of the runs that go on in User Mode Linux, as far as we may see, and their guests' folders."""
    runs: dict[Path, Path] = {}
    for folder in uml_shell.guests():
        with contextlib.suppress(OSError, ValueError):
            words = shlex.split((folder / "command").read_text().splitlines()[-1])
            runs |= {Path(word.removeprefix(OUT)): folder for word in words if word.startswith(OUT)}
    return runs


def enter(folder: Path, arguments: list[str]) -> int:
    """Run `ucp-harness` with these arguments in a guest that runs; its exit status. Raises MachineError."""
    try:
        return uml_shell.enter(folder, _command(arguments), cwd=Path.cwd(), env=_environment())
    except UmlError as error:
        raise MachineError(str(error)) from None


def _command(arguments: list[str]) -> list[str]:
    return [sys.executable, "-P", "-m", "harness.cli", *arguments]


def _environment() -> dict[str, str]:
    """Wherever we were imported from, so is the command inside."""
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": path}
