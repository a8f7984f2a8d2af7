"""Find the files to read: the files that the user gave, and the files in the given directories, each once.

FIFOs, devices and loops of links are omitted.
"""

import filecmp
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from harness.archive.exports import BEFORE_FINAL_RECONCILE, RUN_FILE
from harness.errors import FieldError
from harness.field.ingest._ingest import UnusedPart

_IMPORT_FILE = "import.json"
MAX_FILES = 10_000
MAX_DEPTH = 16
_HARNESS_FILES = {
    *(RUN_FILE, BEFORE_FINAL_RECONCILE, "vehicles", "network.jsonl", "tracks.jsonl", "rogue.jsonl", "lag.jsonl"),
    "channel.jsonl",
    *("report.html", "report.md", "junit.xml", "chains.svg"),
}
"""Names of files in a run directory that the harness wrote. All other files are from agents."""
_OTHER_RUN_FILES = re.compile(r"(\d+|capture|lab|rogue)\.(log|mission\.json|control|store)")
"""Names of other files in a run directory that contain no records of an agent."""
_INCARNATION_DIRECTORY = re.compile(r"\d+-\d+")


def files_of(paths: Iterable[Path], left_out: list[UnusedPart]) -> list[Path]:
    """Return the regular files at `paths`, each once. Raises FieldError if a path does not exist."""
    files: dict[Path, Path] = {}
    by_size: dict[int, list[Path]] = {}
    for path in paths:
        if not os.path.lexists(path):
            raise FieldError(f"{path}: does not exist; give files of a flight, or directories of such files")
        for file in _walk(path, left_out, named=True):
            if len(files) == MAX_FILES:
                left_out.append(
                    UnusedPart(file, f"it and all later files are not read, because at most {MAX_FILES} files are read")
                )
                return [*files.values()]
            try:
                real, size = file.resolve(strict=True), file.stat().st_size
                if real in files:
                    continue
                equal_files = (
                    other for other in by_size.get(size, ()) if size and filecmp.cmp(other, file, shallow=False)
                )
                equal_file = next(equal_files, None)
            except (OSError, RuntimeError) as error:
                why = getattr(error, "strerror", None) or "its links form a loop"
                left_out.append(UnusedPart(file, f"it cannot be read: {why}"))
                continue
            if equal_file is not None and is_incarnation_copy(file):
                continue
            if equal_file is not None:
                left_out.append(UnusedPart(file, f"its content equals {equal_file}"))
                continue
            files[real] = file
            by_size.setdefault(size, []).append(file)
    return [*files.values()]


def is_incarnation_copy(path: Path) -> bool:
    """Return true if the file is the copy of a single incarnation in a run directory.

    The main file of the agent usually contains the same records.
    """
    return path.parent.parent.name == "agents" and _INCARNATION_DIRECTORY.fullmatch(path.parent.name) is not None


def _walk(
    path: Path, left_out: list[UnusedPart], *, named: bool = False, depth: int = 0, in_run: bool = False
) -> Iterator[Path]:
    """Yield the files below a path. The function does not follow links inside a directory, because their targets often
    do not belong to the flight.
    """
    try:
        if path.is_symlink() and not named:
            left_out.append(UnusedPart(path, "it is a link; name its target if the target belongs to the flight"))
        elif path.is_dir():
            if depth > MAX_DEPTH:
                left_out.append(UnusedPart(path, f"it is below more than {MAX_DEPTH} directories"))
                return
            in_run = in_run or (path / RUN_FILE).is_file()
            ignored = _HARNESS_FILES if in_run else {_IMPORT_FILE}
            for inner in sorted(path.iterdir(), key=_files_first):
                if inner.name not in ignored and not (in_run and _OTHER_RUN_FILES.fullmatch(inner.name)):
                    yield from _walk(inner, left_out, depth=depth + 1, in_run=in_run)
        elif path.is_file():
            yield path
        else:
            left_out.append(
                UnusedPart(path, "it is not a regular file, but a FIFO, a socket, a device or a broken link")
            )
    except OSError as error:
        left_out.append(UnusedPart(path, f"it cannot be read: {error.strerror}"))


def _files_first(path: Path) -> tuple[bool, int, str]:
    """Return a sort key that puts files before directories, and short names before long names. For example, 9 comes
    before 10.
    """
    return path.is_dir(), len(path.name), path.name
