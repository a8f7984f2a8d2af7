"""Which files there are: those that are named, and those in directories, each once; no fifo, device or loop."""

import filecmp
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from harness.archive.exports import BEFORE_FINAL_RECONCILE, RUN_FILE
from harness.errors import FieldError
from harness.field.homecoming.homecoming import LeftOut

_IMPORT_FILE = "import.json"
MAX_FILES = 10_000
MAX_DEPTH = 16
_BY_THE_HARNESS = {
    *(RUN_FILE, BEFORE_FINAL_RECONCILE, "vehicles", "network.jsonl", "tracks.jsonl", "rogue.jsonl"),
    *("report.html", "report.md", "junit.xml", "chains.svg"),
}
"""What the harness itself writes into a run directory: no agent left it."""


def files_of(paths: Iterable[Path], left_out: list[LeftOut]) -> list[Path]:
    """The regular files in `paths`, each once. Raises FieldError if a path that is named does not exist."""
    files: dict[Path, Path] = {}
    of_size: dict[int, list[Path]] = {}
    for path in paths:
        if not os.path.lexists(path):
            raise FieldError(f"{path}: does not exist; give files that came home from a flight, or directories of them")
        for file in _walk(path, left_out, named=True):
            if len(files) == MAX_FILES:
                left_out.append(LeftOut(file, f"it and all after it are beyond {MAX_FILES} files, and are not read"))
                return [*files.values()]
            try:
                real, size = file.resolve(strict=True), file.stat().st_size
                if real in files:
                    continue
                twins = (other for other in of_size.get(size, ()) if size and filecmp.cmp(other, file, shallow=False))
                twin = next(twins, None)
            except (OSError, RuntimeError) as error:
                why = getattr(error, "strerror", None) or "its links lead in a circle"
                left_out.append(LeftOut(file, f"it cannot be read: {why}"))
                continue
            if twin is not None:
                left_out.append(LeftOut(file, f"it is the same as {twin}, byte by byte"))
                continue
            files[real] = file
            of_size.setdefault(size, []).append(file)
    return [*files.values()]


def _walk(path: Path, left_out: list[LeftOut], *, named: bool = False, depth: int = 0) -> Iterator[Path]:
    """Links that were not named themselves are not followed: what they lead to is here by itself, or not meant."""
    try:
        if path.is_symlink() and not named:
            left_out.append(LeftOut(path, "it is a link; name what it leads to, if it belongs here"))
        elif path.is_dir():
            if depth > MAX_DEPTH:
                left_out.append(LeftOut(path, f"it is more than {MAX_DEPTH} directories deep"))
                return
            not_here = _BY_THE_HARNESS if (path / RUN_FILE).is_file() else {_IMPORT_FILE}
            for inner in sorted(path.iterdir(), key=_by_number):
                if inner.name not in not_here:
                    yield from _walk(inner, left_out, depth=depth + 1)
        elif path.is_file():
            yield path
        else:
            left_out.append(LeftOut(path, "it is not a file: a fifo, a socket, a device, or a link to nowhere"))
    except OSError as error:
        left_out.append(LeftOut(path, f"it cannot be read: {error.strerror}"))


def _by_number(path: Path) -> tuple[int, str]:
    return len(path.name), path.name
