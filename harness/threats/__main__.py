"""`python -m harness.threats`: play all threats, and put the table into docs/security.md."""

from pathlib import Path

from harness.matrix.thesis import put_between_markers
from harness.threats.table import table
from ucp.files import write_atomically

PAGE = Path(__file__).parents[2] / "docs" / "security.md"

if __name__ == "__main__":
    write_atomically(PAGE, put_between_markers(PAGE.read_text(encoding="utf-8"), "".join(table())))
