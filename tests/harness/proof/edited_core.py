"""Create copies of the agent core with one planted error in each copy, and run proofs with them."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import harness
import ucp

ROOT = Path(harness.__file__).parent.parent
LIMIT_S = 300.0


class Bug(NamedTuple):
    """A planted error: in a file of `ucp/`, the text `right` is replaced by `wrong`."""

    file: str
    right: str
    wrong: str


def edited(directory: Path, *bugs: Bug) -> Path:
    """Copy the agent core to `directory/ucp` and make these edits in the copy. Return `directory`."""
    copy = directory / "ucp"
    shutil.copytree(Path(ucp.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    for bug in bugs:
        path = copy / bug.file
        text = path.read_text("utf-8")
        assert text.count(bug.right) == 1, f"{bug.file} has {bug.right!r} {text.count(bug.right)} times"
        path.write_text(text.replace(bug.right, bug.wrong), "utf-8")
    return directory


def environment(core: Path) -> dict[str, str]:
    """Return environment variables with which a process imports the agent core in the directory `core`."""
    return {**os.environ, "PYTHONPATH": f"{core}{os.pathsep}{ROOT}", "PYTHONDONTWRITEBYTECODE": "1"}


def with_core(core: Path, *arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run `ucp-harness` with the agent core in the directory `core` in place of the installed one."""
    return subprocess.run(
        [sys.executable, "-P", "-m", "harness.cli", *map(str, arguments)],
        cwd=cwd,
        env=environment(core),
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
