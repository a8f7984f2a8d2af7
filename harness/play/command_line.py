"""An agent's command as it is started: agents work in directories of their own, so its files get absolute paths."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from harness.errors import ScenarioError

FIRST_LINE_BYTES = 256
"""So much of it the kernel reads."""


def located(command: Sequence[str], what: str) -> list[str]:
    """The command, wherever it is started. Raises ScenarioError, of `what`, if there is no such program."""
    program, *arguments = command
    path = shutil.which(program)
    if path is None:
        raise ScenarioError(f"{what}: {_why_none(program)}")
    if (interpreter := _interpreter(Path(path))) is not None and not interpreter.exists():
        raise ScenarioError(f"{what}: the first line of {program} names {interpreter}, and that is not there")
    files = (str(Path(word).absolute()) if Path(word).is_file() else word for word in arguments)
    return [str(Path(path).absolute()), *files]


def _interpreter(program: Path) -> Path | None:
    """What the first line of a script names; None if it is none, or may not be read."""
    try:
        with program.open("rb") as file:
            line = file.readline(FIRST_LINE_BYTES)
    except OSError:
        return None
    words = line.removeprefix(b"#!").split(maxsplit=1) if line.startswith(b"#!") else []
    return Path(os.fsdecode(words[0])) if words else None


def _why_none(program: str) -> str:
    if Path(program).name != program and Path(program).is_file():
        return f"{program} is a file that may not be executed: chmod +x, or name its interpreter before it"
    from_here = "" if Path(program).name == program or Path(program).is_absolute() else f" from {Path.cwd()}"
    return f"{program} is no program: give a path{from_here}, or a name on PATH"
