"""An agent's command line, and the last output of a program that has ended.

An agent that lacks a feature of its mission ends with status 127 and a sentence on standard error
(ucp/contract/CONTRACT.md). A shell, env(1) and the first process of a container also end with 127, if they do not find
the program. In that case there is no sentence of the agent, and the run has failed instead of being unsupported.
"""

import os
import re
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


UNSUPPORTED = 127
LOOKED_AT_BYTES = 4096
CHARACTERS = 300

_OF_A_SHELL = re.compile(
    r"(.+: (line )?\d+: .*(not found|No such file or directory)"  # sh, bash
    r"|\S+: command not found: .*|fish: Unknown command.*"  # zsh, fish
    r"|(\S*/)?env: .*No such file or directory"
    r"|\[FATAL tini .*)"  # the first process of a container
)


def last_words_in(log: Path) -> str:
    """The last line of the file that says something; empty if none does."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - LOOKED_AT_BYTES))
            return last_words(file.read().decode("utf-8", "replace"))
    except OSError:
        return ""


def last_words(text: str) -> str:
    """The last line that says something, as one line for people."""
    lines = ("".join(filter(str.isprintable, line)).strip() for line in reversed(text.splitlines()))
    return next(filter(None, lines), "")[:CHARACTERS]


def of_a_shell(words: str) -> bool:
    """Whether a shell, or what else starts programs, says so that it did not find one."""
    return _OF_A_SHELL.fullmatch(words) is not None
