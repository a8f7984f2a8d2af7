"""Edit the agent core as if by mistake, and count the commands that find each mistake and name its handler.

    python -m benchmarks.core_edits [EDIT ...]

`core_edits.yaml` has the edits. The benchmark makes each edit in a copy of the clone. Each command then plays the same
mission. Its five agents lose 30 % of the messages and receive 10 % twice, and an operator orders reconciles. The
benchmark prints a row for each edit: `named` if the command failed and printed the handler, `red` if it only failed,
and `green` otherwise. The exit status is 1 if a row contains `green`. EDIT is the number of an edit, from 1.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).parents[1]
EDITS = Path(__file__).with_name("core_edits.yaml")
MISSION = {
    "duration_s": 500,
    "network": {"loss": 0.3, "duplicate": 0.1},
    "vehicles": {"kind": "none"},
    "events": {"source": "random", "mean_s": 12},
    "timeline": [{"at_s": at_s, "reconcile": [1, 2, 3, 4, 5]} for at_s in (150, 152)],
    "final_reconcile": True,
}
FILES = {
    "scenario.yaml": yaml.safe_dump({"name": "edited core", **MISSION}),
    "matrix.yaml": yaml.safe_dump(
        {"name": "edited core", "scenario": {**MISSION, "network": {"duplicate": 0.1}}, "loss": [0.3], "seeds": 2}
    ),
    "test_edited.py": f"""
import pytest

@pytest.mark.swarm(**{ ({key: MISSION[key] for key in MISSION if key not in ("duration_s", "timeline")})!r})
def test_swarm(swarm):
    swarm.run_for(150)
    swarm.reconcile(1, 2, 3, 4, 5)
    swarm.run_for(2)
    swarm.reconcile(1, 2, 3, 4, 5)
    swarm.run_for(348)
    swarm.final_reconcile()
""",
}
FOLDERS = ("ucp", "harness", "netem", "sitl", "tests")
REFERENCE_TESTS = "tests/harness/checker/reference/test_core_agrees.py"
CLI = ("harness.cli",)
COMMANDS = {
    "run": (*CLI, "run", "scenario.yaml", "--backend", "sim", "--seed", "1", "--out", "run"),
    "matrix": (*CLI, "matrix", "matrix.yaml", "--backend", "sim", "--out", "matrix", "--jobs", "1"),
    "explore": (*CLI, "explore", "scenario.yaml", "--seeds", "2", "--jobs", "1", "--out", "found.yaml"),
    "pytest": ("pytest", "-q", "-p", "no:cacheprovider", "test_edited.py"),
    "make check": ("pytest", "-q", "-x", "-p", "no:cacheprovider", "-k", "random or setting", REFERENCE_TESTS),
}
LIMIT_S = 600.0


class Edit(NamedTuple):
    """An edit of a file of `ucp`, and the handler that the edit breaks. `handler` is empty if no handler is broken."""

    about: str
    file: str
    old: str
    new: str
    handler: str = ""

    def make(self, directory: Path) -> None:
        """Edit the copy of `ucp` in this directory. Raises ValueError if the file no longer has the old text."""
        file = directory / "ucp" / self.file
        text = file.read_text("utf-8")
        if self.old not in text:
            raise ValueError(f"ucp/{self.file} has changed: write the edit {self.about!r} anew")
        file.write_text(text.replace(self.old, self.new, 1), "utf-8")


def read_edits(path: Path) -> list[Edit]:
    return [Edit(**edit) for edit in yaml.safe_load(path.read_text("utf-8"))]


def clone_with(edit: Edit, clone: Path) -> None:
    """Write a clone of the project with this edit."""
    for folder in FOLDERS:
        shutil.copytree(ROOT / folder, clone / folder)
    shutil.copy2(ROOT / "pyproject.toml", clone)
    for name, content in FILES.items():
        (clone / name).write_text(content, "utf-8")
    edit.make(clone)


def outcome(edit: Edit, clone: Path, arguments: tuple[str, ...]) -> str:
    """Return `named`, `red` or `green` for a command in a clone with this edit."""
    done = subprocess.run(
        [sys.executable, "-P", "-m", *arguments],
        cwd=clone,
        env={**os.environ, "PYTHONPATH": str(clone), "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    if done.returncode == 0:
        return "green"
    if done.returncode != 1:
        return f"status {done.returncode}: {done.stderr[-200:]}"
    return "named" if edit.handler and edit.handler in done.stdout + done.stderr else "red"


def main(arguments: list[str]) -> int:
    edits = read_edits(EDITS)
    chosen = [int(argument) for argument in arguments] or range(1, len(edits) + 1)
    missed = False
    sys.stdout.write(f"| edit | handler | {' | '.join(COMMANDS)} |\n{'|---' * (len(COMMANDS) + 2)}|\n")
    for number in chosen:
        edit = edits[number - 1]
        with tempfile.TemporaryDirectory(prefix="core-edit-") as name:
            clone_with(edit, Path(name))
            row = [outcome(edit, Path(name), arguments) for arguments in COMMANDS.values()]
        missed |= any(result not in ("named", "red") for result in row)
        sys.stdout.write(f"| {edit.about} | {edit.handler} | {' | '.join(row)} |\n")
        sys.stdout.flush()
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
