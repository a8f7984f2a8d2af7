"""Reads run.json as it is: whole, half written by a run that was killed, of another version, or edited."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness.archive.lenient_model import fit
from harness.archive.run_record import SCHEMA, JudgedRecord, RunRecord
from harness.errors import RunDirectoryError

MAX_BYTES = 64 * 1024 * 1024
MAX_VALUES = 2_000_000
"""Of 100,000 scripted fates, which are as many as there can be, a record has 1,200,000 values."""


class DamagedRecordError(RunDirectoryError):
    """There is no `run.json`, or what there is was cut off or edited."""


@dataclass(frozen=True)
class RecordFile:
    """`record` is what can be used of a file, and `problems` are sentences that name it, on what cannot."""

    record: RunRecord = field(default_factory=RunRecord)
    judged: JudgedRecord | None = None
    """The same, if all that a judgement needs is there and sound: half of it would make wrong verdicts."""
    problems: list[str] = field(default_factory=list)
    error: RunDirectoryError | None = None
    """Why nothing of it can be used."""


def read_record(path: Path) -> RecordFile:
    """The record in `path`. A file of which nothing can be used has an `error`, in one sentence.

    The error is a DamagedRecordError, unless the file is sound and of another schema.
    """
    try:
        return _read(path)
    except RunDirectoryError as error:
        return RecordFile(problems=[str(error)], error=error)


def _read(path: Path) -> RecordFile:
    document = _document(path)
    try:
        record, misfits = fit(RunRecord, document)
    except ValueError as error:
        raise DamagedRecordError(f"{path}: {error}; it was edited or damaged") from None
    problems = {misfit.key: str(misfit) for misfit in misfits}
    if "roster" not in record.model_fields_set:
        problems.setdefault("roster", "`roster` is missing")
    needed = problems.keys() & JudgedRecord.model_fields.keys()
    first = sorted(problems, key=lambda key: key not in needed)
    sentences = [f"{path}: {problems[key]}; it was edited or damaged" for key in first]
    return RecordFile(record, None if needed else record, sentences)


def _document(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DamagedRecordError(f"{path}: larger than {MAX_BYTES} bytes, which no run's record is")
        text = path.read_text(encoding="utf-8")
        if text.count(",") > MAX_VALUES:
            raise DamagedRecordError(f"{path}: more than {MAX_VALUES} values, which no run's record has")
        document = json.loads(text)
    except OSError as error:
        raise DamagedRecordError(f"{path}: cannot be read: {error.strerror}; is this a run directory?") from None
    except (ValueError, RecursionError):
        raise DamagedRecordError(f"{path}: truncated or damaged: not a JSON document") from None
    if not isinstance(document, dict) or "schema" not in document:
        raise DamagedRecordError(f"{path}: not the result of a run (it has no `schema`)")
    if document["schema"] != SCHEMA:
        raise RunDirectoryError(f"{path}: its schema is {document['schema']!r}, and this version reads {SCHEMA!r}")
    return document
