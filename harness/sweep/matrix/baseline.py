"""`--against` and `--nights`: the matrix.json of an earlier night."""

import json
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from harness.errors import ScenarioError
from harness.sweep.matrix.matrix_file import Matrix
from harness.sweep.matrix.matrix_record import SCHEMA, MatrixRecord
from ucp.short_value import shown

_SAYS_NOTHING_OF_RUNS: Any = {"name": True, "about": True, "keep": True, "scenario": {"name", "about"}}


def load_baseline(path: Path, matrix: Matrix) -> MatrixRecord:
    """Raises ScenarioError if `load_night` does, or nothing can be compared."""
    if len(matrix.seed_list) < 2:
        raise ScenarioError("--against compares 95 % intervals, which one seed has not: give the matrix more `seeds`")
    return load_night(path, matrix)


def load_night(path: Path, matrix: Matrix) -> MatrixRecord:
    """Raises ScenarioError if it is not the finished record of the same matrix."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError):
        raise ScenarioError(f"{path} is not JSON: an earlier night is its matrix.json") from None
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema != SCHEMA:
        claim = f"has schema {shown(schema)}" if schema is not None else "names no schema"
        raise ScenarioError(f"{path} {claim}: an earlier night is its matrix.json, whose schema is {SCHEMA}")
    try:
        record = MatrixRecord.model_validate(document)
    except ValidationError as error:
        place = ".".join(map(str, error.errors()[0]["loc"]))
        raise ScenarioError(
            f"{path} says of itself that it is a {SCHEMA}, but its `{place}` is not: make one with this version"
        ) from None
    before, now = (side.model_dump(mode="json", exclude=_SAYS_NOTHING_OF_RUNS) for side in (record.matrix, matrix))
    differing = [f"`{key}`" for key in now if before[key] != now[key]]
    if differing:
        verb = "differs" if len(differing) == 1 else "differ"
        raise ScenarioError(f"{path} is of another matrix: {', '.join(differing)} {verb}, so nothing can be compared")
    if record.outcome != "completed":
        raise ScenarioError(f"{path} is of a matrix that was {record.outcome}: finish it, or take another night's")
    return record
