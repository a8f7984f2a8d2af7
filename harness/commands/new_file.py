"""Writing a file that a user names, and that must not be there yet."""

import contextlib
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from harness.errors import MachineError, RunDirectoryError


def refuse_existing(paths: Iterable[Path]) -> None:
    """Raises RunDirectoryError if one of them is there already: before work begins that would be for nothing."""
    for path in paths:
        if path.exists():
            raise RunDirectoryError(f"{path} exists: choose another file, nothing is overwritten")


def write_new(path: Path, parts: Iterable[str]) -> None:
    """Raises RunDirectoryError if the file is there already or cannot be made, MachineError if the disk refuses."""
    try:
        file = path.open("x", encoding="utf-8", newline="")
    except FileExistsError:
        raise RunDirectoryError(f"{path} exists: choose another file, nothing is overwritten") from None
    except OSError as error:
        raise RunDirectoryError(f"{path} cannot be made: {error.strerror}; choose another file") from None
    try:
        with file:
            file.writelines(parts)
    except OSError as error:
        with contextlib.suppress(OSError):
            path.unlink()
        raise MachineError(f"{path} cannot be written: {error.strerror}") from None


@contextlib.contextmanager
def newly(path: Path) -> Iterator[None]:
    """Whatever makes the file or directory makes it whole: of half of it nothing is left.

    Raises RunDirectoryError if it is there already or cannot be made, MachineError if the disk refuses.
    """
    refuse_existing([path])
    if not path.absolute().parent.is_dir():
        raise RunDirectoryError(f"{path} cannot be made: its directory is not there; choose another file")
    try:
        yield
    except FileExistsError:
        raise RunDirectoryError(f"{path} exists: choose another file, nothing is overwritten") from None
    except BaseException as error:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise MachineError(f"{path} cannot be written: {error.strerror}") from None
        raise
