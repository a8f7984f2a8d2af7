"""The agent contract: its schemas and vectors are those of the code, and its page has every word that a trace has."""

import json
from pathlib import Path

import pytest

import ucp
from ucp import schemas, vectors

PAGE = (Path(ucp.__path__[0]) / "CONTRACT.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", schemas.DOCUMENTS)
def test_a_schema_is_up_to_date(name: str) -> None:
    assert json.loads(schemas.path(name).read_text()) == schemas.generate(name), "run `python -m ucp.schemas`"


def test_the_vectors_are_up_to_date_to_the_byte() -> None:
    for path, text in vectors.texts().items():
        assert path.read_text(encoding="ascii") == text, "run `python -m ucp.vectors`"
