"""Test that the commands in docs/how-to/find-a-field-bug.md print the output on the page."""

import shutil
from pathlib import Path

from tests.pages import play

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs/how-to/find-a-field-bug.md"


def test_commands_print_the_output_on_the_page(tmp_path: Path) -> None:
    for directory in ("ucp", "docs"):
        shutil.copytree(ROOT / directory, tmp_path / directory, ignore=shutil.ignore_patterns("__pycache__"))
    assert play(PAGE, tmp_path, columns=150) > 12


def test_code_lines_on_the_page_are_current() -> None:
    code = (ROOT / "ucp/quirks/_reconcile_quirks.py").read_text().splitlines()
    assert code[164].strip() == "raise NameError"
    assert code[189].strip() == "core.start(core.phase_three_timer, 0.0)"
