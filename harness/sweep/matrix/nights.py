"""Store the results of a matrix for every night, and choose the night with which a matrix is compared."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from harness.errors import MachineError, RunDirectoryError, ScenarioError
from harness.sweep.matrix._matrix_file import Matrix, MatrixPoint
from harness.sweep.matrix.matrix_record import SCHEMA, MatrixRecord
from ucp.agent_files import write_json_atomically
from ucp.plain_file import json_problem, read_json
from ucp.short_value import shown

MAX_REASONS = 10
"""Maximum number of differences between two matrices that a message lists."""
_IRRELEVANT_KEYS: Any = {"name": True, "about": True, "keep": True, "scenario": {"name", "about"}}


class OtherVersionError(ScenarioError):
    """An error: this version of the harness cannot read the file matrix.json."""


@dataclass(frozen=True, slots=True)
class BaselineNight:
    """An earlier night, with which results are compared."""

    path: Path
    record: MatrixRecord | None
    """The results of the night. None if another version of the harness wrote the file and this version cannot
    read it.
    """
    points: frozenset[MatrixPoint]
    not_compared: list[str]
    """The reasons why some combinations of values are not compared."""


def load_baseline(path: Path, matrix: Matrix) -> BaselineNight:
    """Load an earlier night for a comparison. If the matrix of that night is different, some combinations of values are
    not compared.

    Raises ScenarioError if the file does not contain the results of a finished matrix, or if the matrix has only one
    seed.
    """
    if len(matrix.seed_list) < 2:
        raise ScenarioError("--against compares 95 % intervals, which need several seeds: give the matrix more `seeds`")
    try:
        record = _load(path)
    except OtherVersionError as error:
        return BaselineNight(path, None, frozenset(), [f"{error}, so no cell is compared"])
    if record.matrix.traces != matrix.traces:
        reason = f"`traces` was {shown(record.matrix.traces)} and is {shown(matrix.traces)}, so no cell is compared"
        return BaselineNight(path, record, frozenset(), [reason])
    earlier = frozenset(record.matrix.points)
    points: set[MatrixPoint] = set()
    reasons: dict[str, None] = {}
    for point in matrix.points:
        if point not in earlier:
            reasons["the baseline lacks some cells, which are not compared"] = None
            continue
        differing = [*_differing(_scenario_at(record.matrix, point), _scenario_at(matrix, point), "scenario")]
        if not differing:
            points.add(point)
        reasons |= dict.fromkeys(f"{each}, so the baseline is not compared" for each in differing)
    return BaselineNight(path, record, frozenset(points), [*reasons][:MAX_REASONS])


def _scenario_at(matrix: Matrix, point: MatrixPoint) -> Any:
    return matrix.scenario_at(point).model_dump(mode="json", exclude={"name", "about"})


def _differing(before: Any, now: Any, key: str) -> Iterator[str]:
    """Yield a phrase for each key of the matrix whose value differs from an earlier night."""
    if isinstance(before, dict) and isinstance(now, dict):
        for name in dict.fromkeys((*before, *now)):
            yield from _differing(before.get(name), now.get(name), f"{key}.{name}")
    elif before != now:
        yield f"`{key}` was {shown(before)} and is {shown(now)}"


def load_night(path: Path, matrix: Matrix) -> MatrixRecord:
    """Load matrix.json. Raises ScenarioError if the file does not contain the results of a finished run of the same
    matrix.
    """
    record = _load(path)
    before, now = (side.model_dump(mode="json", exclude=_IRRELEVANT_KEYS) for side in (record.matrix, matrix))
    differing = [f"`{key}`" for key in now if before[key] != now[key]]
    if differing:
        verb = "differs" if len(differing) == 1 else "differ"
        raise ScenarioError(
            f"{path} contains results of another matrix: {', '.join(differing)} {verb}, so the nights cannot be "
            "compared"
        )
    return record


MAX_BYTES = 64 * 1024 * 1024


def _load(path: Path) -> MatrixRecord:
    """Load matrix.json. Raises ScenarioError if the file cannot be read, has another kind of schema, or belongs to an
    unfinished matrix.

    Raises OtherVersionError if the file has another version of the schema, or does not match its schema.
    """
    try:
        document = read_json(path, MAX_BYTES)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ScenarioError(f"{path}: {json_problem(error)}; name the matrix.json of an earlier night") from None
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema != SCHEMA and isinstance(schema, str) and re.fullmatch(rf"{SCHEMA.partition('/')[0]}/\d{{1,9}}", schema):
        raise OtherVersionError(f"{path} has schema {schema}, and this version of the harness reads {SCHEMA}")
    if schema != SCHEMA:
        claim = f"has schema {shown(schema)}" if schema is not None else "names no schema"
        raise ScenarioError(f"{path} {claim}: name the matrix.json of an earlier night, whose schema is {SCHEMA}")
    try:
        record = MatrixRecord.model_validate(document)
    except ValidationError as error:
        place = ".".join(map(str, error.errors()[0]["loc"]))
        raise OtherVersionError(f"{path}: this version of the harness cannot read its `{place}`") from None
    if record.outcome != "completed":
        raise ScenarioError(
            f"{path} contains results of a matrix that was {record.outcome}: finish the matrix, or name another night"
        )
    return record


LAST = 60
"""Maximum number of nights that are read, with one file for each night. If there are more files, only the newest ones
are read. The names of the files begin with the date, so the newest files are the last ones in alphabetical order.
"""


@dataclass(frozen=True, slots=True)
class StoredNights:
    """The stored nights of one matrix, sorted by start time. `left_out` contains a sentence for each file that cannot
    be used.
    """

    directory: Path
    records: list[MatrixRecord]
    left_out: list[str]

    @property
    def said_left_out(self) -> str:
        """Return a phrase with the number of unusable files. Return an empty text if all files are usable."""
        if not self.left_out:
            return ""
        number = len(self.left_out)
        files, are = ("file", "is") if number == 1 else ("files", "are")
        return f"{number} {files} in {self.directory} {are} not in the trend"


def opened(directory: Path) -> Path:
    """Create the directory if it does not exist. Raises RunDirectoryError if this is impossible."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunDirectoryError(f"{directory} cannot be created: {error.strerror}; choose another --nights") from None
    return directory


def keep(record: MatrixRecord, directory: Path) -> None:
    """Store a finished night. If the night is already stored, do nothing. Raises MachineError if the file cannot be
    written.
    """
    if record.outcome != "completed":
        return
    path = directory / f"{re.sub('[^0-9TZ]', '', record.started_at)}.json"
    try:
        write_json_atomically(path, record.model_copy(update={"results": []}).to_json())
    except OSError as error:
        raise MachineError(f"{path} cannot be written: {error.strerror}") from None


def read(directory: Path, matrix: Matrix) -> StoredNights:
    """Return the stored nights of `matrix` in `directory`."""
    records, left_out = [], []
    for path in sorted(directory.glob("*.json"))[-LAST:]:
        try:
            records.append(load_night(path, matrix))
        except ScenarioError as error:
            left_out.append(str(error))
    return StoredNights(directory, sorted(records, key=lambda record: record.started_at), left_out)
