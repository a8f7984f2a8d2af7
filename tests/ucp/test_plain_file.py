"""Test the reader of files from unknown sources: it refuses special files, large files and deeply nested JSON."""

import os
from pathlib import Path

import pytest

from ucp.plain_file import MAX_JSON_WEIGHT, json_problem, open_plain_file, parse_json, read_json, read_plain_file

pytestmark = pytest.mark.any_user


def test_special_files_are_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    for path in (tmp_path / "fifo", Path("/dev/zero"), tmp_path, tmp_path / "a\0b"):
        with pytest.raises(OSError, match=r"is not a file|is a directory|the name is not valid"):
            open_plain_file(path)


def test_file_above_the_limit_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x" * 10)
    assert read_plain_file(path, 10) == b"x" * 10
    with pytest.raises(OSError, match="larger than 9 bytes"):
        read_plain_file(path, 9)
    os.truncate(path, 1 << 40)  # a file with a hole takes no space
    with pytest.raises(OSError, match="larger than 10 bytes"):
        read_plain_file(path, 10)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[" * 10_000, "nested too deeply"),
        ("[" + "1," * MAX_JSON_WEIGHT + "1]", "too many values"),
        ("[" + "[]," * (MAX_JSON_WEIGHT // 5) + "1]", "too many values"),
        ("9" * 5000, "a number of thousands of digits"),
        ("[1,\n2", "not JSON at line 2"),
        (b"\xff\xfe[\0]\0", "not UTF-8 text"),
    ],
)
def test_hostile_json_is_refused_with_a_reason(text: str | bytes, problem: str) -> None:
    with pytest.raises(ValueError) as refused:
        parse_json(text)
    assert json_problem(refused.value) == problem


def test_json_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "file").write_text('{"a": [1, "é"]}', encoding="utf-8")
    assert read_json(tmp_path / "file", 100) == {"a": [1, "é"]}
