"""Nothing is overwritten: a directory of results is new or empty."""

from pathlib import Path

import pytest

from harness.errors import RunDirectoryError
from harness.rundir import claim


def test_a_directory_that_holds_anything_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "kept").touch()
    with pytest.raises(RunDirectoryError, match="is not empty: choose another --out"):
        claim(tmp_path)
    with pytest.raises(RunDirectoryError, match="is not a directory"):
        claim(tmp_path / "kept")
    claim(tmp_path / "new" / "one", tmp_path / "new" / "one" / "inner")
    assert (tmp_path / "new" / "one" / "inner").is_dir()
