"""Damaged files by the hundred; `python -m benchmarks.fuzz_readers` gives them by the hundred thousand."""

from pathlib import Path

import pytest

from tests.harness.field.fuzz import FailedError, Outcome, fuzz

FILES = 400


def test_no_damaged_file_breaks_a_reader_or_vanishes_unnamed(tmp_path: Path) -> None:
    outcome = Outcome()
    assert sum(1 for _ in fuzz(tmp_path, 15, 0, FILES, outcome)) == FILES
    readers = {reader.removesuffix(Path(reader).suffix).strip() for reader, _ in outcome.counts}
    assert readers == {"sort_out", "among others", "import", "check", "replay", "archive"}


def test_a_reader_that_drops_lines_without_a_word_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.field.homecoming.lives.TraceReader._left_out", lambda reader: iter(()))
    with pytest.raises(FailedError, match="nobody says"):
        list(fuzz(tmp_path, 15, 0, FILES, Outcome()))


def test_a_reader_that_raises_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.field.homecoming.lives._entry", lambda line: 1 // (b"NaN" not in line))
    with pytest.raises(FailedError):
        list(fuzz(tmp_path, 15, 0, FILES, Outcome()))
