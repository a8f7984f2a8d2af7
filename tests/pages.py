"""Pages of the documentation whose commands run, one after another, and print what the page shows.

A block of `console` has commands after `$ `, each with what it prints: `…` is anything in its line, and alone in a line
any lines. A block with a `title` is a file of that name.
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
OF_THE_COMMAND_ALONE = re.compile(r"ucp-harness( [\w./=:,+-]+)+")
"""What a shell would change nothing of."""


def play(page: Path, directory: Path, columns: int = 120) -> int:
    """Do what the page says in `directory`, on a terminal of so many columns, and compare; how many commands it has."""
    tried = 0
    for language, title, body in _blocks(page):
        if title:
            (directory / title).write_text(body)
        elif language == "console":
            for typed, shown in _commands(body):
                _compare(typed, shown, directory, columns)
                tried += 1
    return tried


def _blocks(page: Path) -> Iterator[tuple[str, str, str]]:
    """Language, title or nothing, and content."""
    yield from re.findall(
        r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```', page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )


def _commands(body: str) -> Iterator[tuple[str, list[str]]]:
    for command in re.split(r"^\$ ", body, flags=re.MULTILINE)[1:]:
        typed, *shown = command.splitlines()
        yield typed, shown


def _compare(typed: str, shown: list[str], directory: Path, columns: int) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "COLUMNS": str(columns), "NO_COLOR": "1"}
    if OF_THE_COMMAND_ALONE.fullmatch(typed):
        ended = harness(*typed.split()[1:], env=environment, cwd=directory, deadline_s=DEADLINE_S)
    else:
        ended = subprocess.run(
            ["bash", "-c", typed],
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
    assert re.fullmatch(_pattern(shown), printed), f"{typed}\n{printed}"


def _pattern(shown: list[str]) -> str:
    return "".join(
        r"(?:.*\n)*?" if line == LEFT_OUT else re.escape(line).replace(re.escape(LEFT_OUT), ".*") + r" *\n"
        for line in shown
    )
