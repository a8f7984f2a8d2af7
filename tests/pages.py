"""Run the commands of a documentation page, and compare their output with the page.

A code block of the language `console` has commands after `$ `. The output of a command follows it. In the output, `…`
stands for any text within a line, and a line with only `…` stands for any lines. A block with a `title` is the content
of a file with this name.
"""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.harness.command import harness

REPOSITORY = Path(__file__).parents[1]
LEFT_OUT = "…"
DEADLINE_S = 120
SIMPLE_COMMAND = re.compile(r"ucp-harness( [\w./=:,+-]+)+")
"""Matches a call of `ucp-harness` without special characters of the shell. Such a call needs no shell."""


def play(page: Path, directory: Path, columns: int = 120) -> int:
    """Run the commands of the page in `directory`, and compare their output. Return the number of commands.

    `columns` is the width of the terminal.
    """
    tried = 0
    for language, title, body in _blocks(page):
        if title:
            (directory / title).write_text(body)
        elif language == "console":
            for command, shown in _commands(body):
                _compare(command, shown, directory, columns)
                tried += 1
    return tried


def _blocks(page: Path) -> Iterator[tuple[str, str, str]]:
    """Yield the language, title and content of each code block. The title may be empty."""
    yield from re.findall(
        r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```', page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )


def _commands(body: str) -> Iterator[tuple[str, list[str]]]:
    for command in re.split(r"^\$ ", body, flags=re.MULTILINE)[1:]:
        command, *shown = command.splitlines()
        yield command, shown


def _compare(command: str, shown: list[str], directory: Path, columns: int) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "COLUMNS": str(columns), "NO_COLOR": "1"}
    if SIMPLE_COMMAND.fullmatch(command):
        ended = harness(*command.split()[1:], env=environment, cwd=directory, deadline_s=DEADLINE_S)
    else:
        ended = subprocess.run(
            ["bash", "-c", command],
            cwd=directory,
            env={**environment, "LC_ALL": "C.UTF-8"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )
    printed = f"{ended.stdout}{ended.stderr}".replace(f"{directory}/", "").replace(f"{REPOSITORY}/", "")
    printed = printed.replace("\u00a0", " ")
    assert re.fullmatch(_pattern(shown), printed), f"{command}\n{printed}"


def _pattern(shown: list[str]) -> str:
    return "".join(
        r"(?:.*\n)*?" if line == LEFT_OUT else re.escape(line).replace(re.escape(LEFT_OUT), ".*") + r" *\n"
        for line in shown
    )
