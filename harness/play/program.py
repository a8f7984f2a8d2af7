"""An agent's command as it is started: agents work in directories of their own, so its files get absolute paths."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from harness.errors import ScenarioError


def located(command: Sequence[str], what: str) -> list[str]:
    """The command, wherever it is started. Raises ScenarioError, of `what`, if there is no such program."""
    program, *arguments = command
    path = shutil.which(program)
    if path is None:
        raise ScenarioError(f"{what}: {_why_none(program)}")
    files = (str(Path(word).absolute()) if Path(word).is_file() else word for word in arguments)
    return [str(Path(path).absolute()), *files]


def _why_none(program: str) -> str:
    if Path(program).name != program and Path(program).is_file():
        return f"{program} is a file that may not be executed: chmod +x, or name its interpreter before it"
    return f"{program} is no program: give a path, or a name on PATH"
