"""Read run.json in any condition: complete, truncated, modified, or of another version.

The module removes the smallest invalid parts until the remaining document is valid. For example, if some entries of a
list are invalid, it removes only these entries. If a required key of an entry is missing, it removes the entry. The
alternative was to reject the whole file. Then the record of every killed run would be lost.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from harness.archive.exports import MAX_ERRORS
from harness.archive.run_record import SCHEMA, JudgedRecord, RunRecord
from harness.errors import RunDirectoryError
from ucp.plain_file import MAX_JSON_WEIGHT, json_problem, read_json
from ucp.short_value import shown

Model = TypeVar("Model", bound=BaseModel)
Place = tuple[dict[Any, Any] | list[Any], Any]
"""The place of a part in a document, as a pair: the object or list that contains the part, and the key or index at
which it contains the part.
"""

MAX_ROUNDS = 100
"""Maximum number of validations. After each validation, the invalid parts are removed. The object that contained a
removed part may then be invalid, too, so the depth of a document limits the number of validations.
"""
MAX_NAME = 80
UNKNOWN_KEY = "extra_forbidden"
LONE_SURROGATE = "string_unicode"
MISSING = "missing"
MODEL_TYPE = "model_type"
"""The error type with which pydantic reports a value that is no object."""
NOT_AN_OBJECT = "input should be an object"


@dataclass(frozen=True)
class InvalidPart:
    """The invalid parts of run.json below one top-level key.

    `where` and `what` describe the first invalid part. `more` is the number of further invalid parts.
    """

    key: str
    where: str
    what: str
    more: int

    def __str__(self) -> str:
        more = f" (and {self.more} more)" if self.more else ""
        return f"`{self.where}` is wrong: {self.what}{more}"


def validate_leniently(model: type[Model], document: dict[str, Any]) -> tuple[Model, list[InvalidPart]]:
    """Return the valid part of `document` as an object of type `model`, and a description of the parts that were
    removed.

    All keys of the model must have defaults. Unknown keys are ignored. A lone surrogate in a text becomes a question
    mark. The function changes `document`. Raises ValueError if the document has more than MAX_ERRORS errors.
    """
    invalid_parts: dict[str, InvalidPart] = {}
    for _ in range(MAX_ROUNDS):
        try:
            return model.model_validate(document), list(invalid_parts.values())
        except ValidationError as error:
            if error.error_count() > MAX_ERRORS:
                raise ValueError(f"{error.error_count()} errors in it") from None
            errors = error.errors(include_url=False, include_context=False, include_input=False)
        for part in _by_key(document, errors):
            invalid_parts.setdefault(part.key, part)
        places = [(problem, _place(document, problem["loc"])[0]) for problem in errors]
        _remove([place for problem, place in places if not _repair(place, problem)])
    return model(), list(invalid_parts.values())


def _by_key(document: dict[str, Any], errors: Sequence[ErrorDetails]) -> Iterator[InvalidPart]:
    by_key: dict[str, dict[str, str]] = {}
    for problem in errors:
        if problem["type"] not in (UNKNOWN_KEY, LONE_SURROGATE):
            _, path = _place(document, problem["loc"])
            path += problem["loc"][-1:] if problem["type"] == MISSING else ()
            where = ".".join(str(step)[:MAX_NAME] for step in path)
            what = NOT_AN_OBJECT if problem["type"] == MODEL_TYPE else problem["msg"].lower()
            by_key.setdefault(str(problem["loc"][0]), {}).setdefault(where, what)
    for key, wrong in by_key.items():
        where, what = next(iter(wrong.items()))
        yield InvalidPart(key, where, what, len(wrong) - 1)


def _place(document: dict[str, Any], loc: Sequence[int | str]) -> tuple[Place, list[int | str]]:
    """Return the innermost part of the document that contains an error, and the path to this part.

    `loc` is the error location from pydantic. It may contain additional elements, which name the types that pydantic
    tried. The path omits these elements.
    """
    place: Place = document, loc[0]
    value: Any = document
    path = []
    for step in loc:
        in_list = isinstance(value, list) and isinstance(step, int) and step < len(value)
        if in_list or (isinstance(value, dict) and step in value):
            place, value = (value, step), value[step]
            path.append(step)
    return place, path


def _repair(place: Place, problem: ErrorDetails) -> bool:
    """Replace lone surrogates in a text of run.json by question marks. Return true if the invalid part of the document
    was a text with lone surrogates.
    """
    holder, key = place
    if problem["type"] == LONE_SURROGATE and isinstance(text := holder[key], str):
        holder[key] = text.encode(errors="replace").decode()
        return bool(holder[key] != text)
    return False


def _remove(places: Sequence[Place]) -> None:
    """Remove parts of a document. Elements of the same list are removed together, so that their indices stay valid."""
    lists: dict[int, tuple[list[Any], set[int]]] = {}
    for holder, key in places:
        if isinstance(holder, dict):
            holder.pop(key, None)
        else:
            lists.setdefault(id(holder), (holder, set()))[1].add(key)
    for holder, indices in lists.values():
        holder[:] = [part for index, part in enumerate(holder) if index not in indices]


MAX_BYTES = 40 * 1024 * 1024
MAX_WEIGHT = 2_000_000
"""Maximum weight of a run.json. The weight of a text is a measure of the memory that its JSON values need (see
`ucp.plain_file`). A file whose scenario has 100,000 scripted message fates has less weight.
"""


class DamagedRecordError(RunDirectoryError):
    """An error: the file run.json is missing, truncated or was modified."""


@dataclass(frozen=True)
class RecordFile:
    """The content of a run.json. `record` is its valid part, and `problems` describes its invalid parts."""

    record: RunRecord = field(default_factory=RunRecord)
    judged: JudgedRecord | None = None
    """The part of run.json that the checker needs. None if a key of this part is invalid, because verdicts on
    incomplete data would be wrong.
    """
    problems: list[str] = field(default_factory=list)
    error: RunDirectoryError | None = None
    """The reason why no part of the file can be used. None if a part can be used."""


def read_record(path: Path) -> RecordFile:
    """Read the file run.json at `path`. If no part of the file can be used, the result has an `error`. The error is a
    DamagedRecordError if the file is damaged. If the file is intact but has a different schema, the error is of another
    class.
    """
    try:
        return _read(path)
    except RunDirectoryError as error:
        return RecordFile(problems=[str(error)], error=error)


def _read(path: Path) -> RecordFile:
    document = _document(path)
    try:
        record, invalid_parts = validate_leniently(RunRecord, document)
    except ValueError as error:
        raise DamagedRecordError(f"{path}: {error}; it was edited or damaged") from None
    problems = {part.key: str(part) for part in invalid_parts}
    if "roster" not in record.model_fields_set:
        problems.setdefault("roster", "`roster` is missing")
    needed = problems.keys() & JudgedRecord.model_fields.keys()
    first = sorted(problems, key=lambda key: key not in needed)
    sentences = [f"{path}: {problems[key]}; it was edited or damaged" for key in first]
    return RecordFile(record, None if needed else record, sentences)


def _document(path: Path) -> dict[str, object]:
    try:
        document = read_json(path, MAX_BYTES, MAX_WEIGHT)
    except OSError as error:
        raise DamagedRecordError(f"{path}: cannot be read: {error.strerror}; is this a run directory?") from None
    except ValueError as error:
        raise DamagedRecordError(f"{path}: truncated or damaged: {json_problem(error)}") from None
    if _exceeds(document, MAX_JSON_WEIGHT):
        raise DamagedRecordError(f"{path}: truncated or damaged: too many values")
    if not isinstance(document, dict) or "schema" not in document:
        raise DamagedRecordError(f"{path}: not the result of a run (it has no `schema`)")
    if document["schema"] != SCHEMA:
        raise RunDirectoryError(f"{path}: its schema is {shown(document['schema'])}, and this version reads {SCHEMA!r}")
    return document


_SCRIPTS = ("fates", "datagrams")


def _exceeds(document: Any, most: int) -> bool:
    """Return true if a document has more than `most` values. The scripted messages of its scenario are not counted,
    because their validation ends at the first error.
    """
    parts: list[Any] = [document]
    count = 0
    while parts and count <= most:
        part = parts.pop()
        if isinstance(part, dict):
            values = [value for key, value in part.items() if key not in _SCRIPTS or not isinstance(value, list)]
        else:
            values = part
        count += len(values)
        parts += [value for value in values if isinstance(value, dict | list)]
    return count > most
