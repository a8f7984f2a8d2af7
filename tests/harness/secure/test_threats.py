"""Test that each row of the table of attacks shows the real result."""

import re
from pathlib import Path

import pytest

from docs.generate.threats import ROWS, Row, table

PAGE = (Path(__file__).parents[3] / "docs/explanation/security.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("row", ROWS, ids=lambda row: re.sub(r"\W+", "-", f"{row.who} {row.does}"))
def test_each_attack_has_the_result_in_the_table(row: Row) -> None:
    _, line = table([row])
    assert line in PAGE


def test_the_table_has_these_rows_alone() -> None:
    written = PAGE.split("<!-- table: begin -->")[1].split("<!-- table: end -->")[0]
    assert len(written.strip().splitlines()) == 2 + len(ROWS)
