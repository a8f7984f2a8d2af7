"""Play each attack in the table of attacks, and test that its row shows the result."""

import re
from pathlib import Path

import pytest

from docs.generate.threats import ROWS, Row, table

PAGE_OF_THREATS = Path(__file__).parents[3] / "docs/explanation/threat-model.md"
PAGE = (Path(__file__).parents[3] / "docs/explanation/security.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("row", ROWS, ids=lambda row: re.sub(r"\W+", "-", f"{row.who} {row.does}"))
def test_each_attack_has_the_result_in_the_table(row: Row) -> None:
    _, line = table([row])
    assert line in PAGE


def test_table_has_only_the_tested_rows() -> None:
    written = PAGE.split("<!-- table: begin -->")[1].split("<!-- table: end -->")[0]
    assert len(written.strip().splitlines()) == 2 + len(ROWS)


def test_threat_model_names_existing_tests() -> None:
    page = PAGE_OF_THREATS.read_text(encoding="utf-8")
    named = re.findall(r"\[(test_\w+)\]\((\S+)\)", page)
    assert len(named) > 30
    for name, path in named:
        assert f"def {name}(" in (PAGE_OF_THREATS.parent / path).read_text(encoding="utf-8"), name
