"""`--kernel uml`: the same command line in User Mode Linux, for machines without netem, or without any privilege."""

import os
import sys
from enum import StrEnum
from pathlib import Path

from harness.errors import MachineError
from netem import uml
from netem.errors import UmlError


class Kernel(StrEnum):
    host = "host"
    uml = "uml"


def run_inside(arguments: list[str]) -> int:
    """Run `ucp-harness` with these arguments in User Mode Linux, from where we are; its exit status.

    Raises MachineError if User Mode Linux is not here, or fails.
    """
    # Wherever we were imported from, so is the command inside.
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-P", "-m", "harness.cli", *arguments]
    try:
        return uml.run(command, cwd=Path.cwd(), env={**os.environ, "PYTHONPATH": path})
    except UmlError as error:
        raise MachineError(str(error)) from None
