"""Play all attacks, and write the table in docs/explanation/security.md: `python -m docs.generate.threats`."""

from pathlib import Path

from docs.generate.matrix_thesis import put_between_markers
from docs.generate.threats.threat_table import table
from ucp.agent_files import write_atomically

PAGE = Path(__file__).parents[3] / "docs/explanation/security.md"

if __name__ == "__main__":
    write_atomically(PAGE, put_between_markers(PAGE.read_text(encoding="utf-8"), "".join(table())))
