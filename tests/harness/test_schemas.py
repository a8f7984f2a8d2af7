"""The JSON Schemas in the repository are those of the code."""

import json

import pytest

from harness.schemas import MODELS, generate, path


@pytest.mark.parametrize("name", MODELS)
def test_the_schema_is_up_to_date(name: str) -> None:
    assert json.loads(path(name).read_text()) == generate(name), "run `python -m harness.schemas`"
