"""Where the runs of tests leave their files. Tests may run side by side, in processes that do not know each other."""

import re
import shutil
from itertools import count
from pathlib import Path
from typing import cast

import pytest

from harness.errors import RunDirectoryError
from harness.pytest_plugin.options import Options

MAX_NAME = 100


def new_directory(node: pytest.Item, options: Options) -> Path:
    """An empty directory of its own for a run of this test. Raises RunDirectoryError."""
    name = re.sub(r"\W+", "-", node.nodeid).strip("-")[-MAX_NAME:]
    if options.keep is None:
        factory = node.config._tmp_path_factory  # type: ignore[attr-defined] # a file that is a test has no fixtures
        return cast(pytest.TempPathFactory, factory).mktemp(name)
    for number in count(1):
        directory = options.keep / (name if number == 1 else f"{name}-{number}")
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise RunDirectoryError(f"--ucp-keep: {directory} cannot be made: {error.strerror}") from None
        return directory
    raise AssertionError("numbers do not end")


def discard(directory: Path, options: Options) -> None:
    """Remove the directory of a run that went as expected, unless it is to be kept."""
    if options.keep is None:
        shutil.rmtree(directory, ignore_errors=True)
