"""docs/field-bugs.md is true: each of its commands runs, and prints what the page shows."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs/field-bugs.md"
LOGS = ROOT / "docs/field_test_2020.tar.xz"
LEFT_OUT = "…"
MAX_BYTES = 1_500_000


def commands() -> Iterator[tuple[str, list[str]]]:
    """Each command of the page, with the lines that it shows."""
    for block in re.findall(r"```console\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL):
        for command in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            typed, *shown = command.splitlines()
            yield typed, shown


def pattern(shown: list[str]) -> str:
    lines = (
        r"(?:.*\n)*?" if line == LEFT_OUT else re.escape(line).replace(re.escape(LEFT_OUT), ".*") + r" *\n"
        for line in shown
    )
    return "".join(lines)


def test_every_command_of_the_page_prints_what_it_shows(tmp_path: Path) -> None:
    for directory in ("ucp", "docs"):
        shutil.copytree(ROOT / directory, tmp_path / directory, ignore=shutil.ignore_patterns("__pycache__"))
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "COLUMNS": "150", "NO_COLOR": "1", "LC_ALL": "C.UTF-8"}
    tried = list(commands())
    assert len(tried) > 12
    for typed, shown in tried:
        ended = subprocess.run(
            ["bash", "-c", typed], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
        )
        printed = f"{ended.stdout}{ended.stderr}".replace(f"{tmp_path}/", "").replace(f"{ROOT}/", "")
        assert re.fullmatch(pattern(shown), printed), f"{typed}\n{printed}"


def test_the_logs_are_small_and_of_six_vehicles() -> None:
    assert LOGS.stat().st_size < MAX_BYTES
    with tarfile.open(LOGS) as archive:
        traces = {int(name.split("/")[-1].split(".")[0]) for name in archive.getnames() if ".trace.jsonl" in name}
    assert traces == {10, 28, 32, 118, 120, 122}


def test_the_lines_that_the_page_comes_to_are_those_of_the_code() -> None:
    code = (ROOT / "ucp/quirks/reconcile.py").read_text().splitlines()
    assert code[164].strip() == "raise NameError"
    assert code[189].strip() == "core.start(core.phase_three_timer, 0.0)"
