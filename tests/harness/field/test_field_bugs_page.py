"""Test that the commands in docs/how-to/find-a-field-bug.md print the output on the page."""

import shutil
import tarfile
from pathlib import Path

from tests.pages import play

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs/how-to/find-a-field-bug.md"
LOGS = ROOT / "docs/field_test_2020.tar.xz"
MAX_BYTES = 1_500_000


def test_commands_print_the_output_on_the_page(tmp_path: Path) -> None:
    for directory in ("ucp", "docs"):
        shutil.copytree(ROOT / directory, tmp_path / directory, ignore=shutil.ignore_patterns("__pycache__"))
    assert play(PAGE, tmp_path, columns=150) > 12


def test_logs_are_small_and_from_six_vehicles() -> None:
    assert LOGS.stat().st_size < MAX_BYTES
    with tarfile.open(LOGS) as archive:
        traces = {int(name.split("/")[-1].split(".")[0]) for name in archive.getnames() if ".trace.jsonl" in name}
    assert traces == {10, 28, 32, 118, 120, 122}


def test_code_lines_on_the_page_are_current() -> None:
    code = (ROOT / "ucp/quirks/_reconcile_quirks.py").read_text().splitlines()
    assert code[164].strip() == "raise NameError"
    assert code[189].strip() == "core.start(core.phase_three_timer, 0.0)"
