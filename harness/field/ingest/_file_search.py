"""Which files there are: those that are named, and those in directories, each once; no fifo, device or loop."""

import filecmp
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from harness.archive.exports import BEFORE_FINAL_RECONCILE, RUN_FILE
from harness.errors import FieldError
from harness.field.ingest._ingest import LeftOut

_IMPORT_FILE = "import.json"
MAX_FILES = 10_000
MAX_DEPTH = 16
_BY_THE_HARNESS = {
    *(RUN_FILE, BEFORE_FINAL_RECONCILE, "vehicles", "network.jsonl", "tracks.jsonl", "rogue.jsonl"),
    *("report.html", "report.md", "junit.xml", "chains.svg"),
}
"""What the harness itself writes into a run directory: no agent left it."""
_NO_RECORD = re.compile(r"(\d+|capture|lab|rogue)\.(log|mission\.json|control|store)")
"""What else is in a run directory, and is no record of an agent."""
_LIFE = re.compile(r"\d+-\d+")


def files_of(paths: Iterable[Path], left_out: list[LeftOut]) -> list[Path]:
    """The regular files in `paths`, each once. Raises FieldError if a path that is named does not exist."""
    files: dict[Path, Path] = {}
    of_size: dict[int, list[Path]] = {}
    for path in paths:
        if not os.path.lexists(path):
            raise FieldError(f"{path}: does not exist; give files of a flight, or directories of such files")
        for file in _walk(path, left_out, named=True):
            if len(files) == MAX_FILES:
                left_out.append(
                    LeftOut(file, f"it and all later files are not read, because at most {MAX_FILES} files are read")
                )
                return [*files.values()]
            try:
                real, size = file.resolve(strict=True), file.stat().st_size
                if real in files:
                    continue
                twins = (other for other in of_size.get(size, ()) if size and filecmp.cmp(other, file, shallow=False))
                twin = next(twins, None)
            except (OSError, RuntimeError) as error:
                why = getattr(error, "strerror", None) or "its links form a loop"
                left_out.append(LeftOut(file, f"it cannot be read: {why}"))
                continue
            if twin is not None and is_of_a_life(file):
                continue
            if twin is not None:
                left_out.append(LeftOut(file, f"its content equals {twin}"))
                continue
            files[real] = file
            of_size.setdefault(size, []).append(file)
    return [*files.values()]


def is_of_a_life(path: Path) -> bool:
    """Whether a run put it aside for one life of an agent: it is among those of all lives, too, as a rule."""
    return path.parent.parent.name == "agents" and _LIFE.fullmatch(path.parent.name) is not None


def _walk(
    path: Path, left_out: list[LeftOut], *, named: bool = False, depth: int = 0, of_run: bool = False
) -> Iterator[Path]:
    """Links that were not named themselves are not followed: what they lead to is here by itself, or not meant."""
    try:
        if path.is_symlink() and not named:
            left_out.append(LeftOut(path, "it is a link; name its target if the target belongs to the flight"))
        elif path.is_dir():
            if depth > MAX_DEPTH:
                left_out.append(LeftOut(path, f"it is below more than {MAX_DEPTH} directories"))
                return
            of_run = of_run or (path / RUN_FILE).is_file()
            not_here = _BY_THE_HARNESS if of_run else {_IMPORT_FILE}
            for inner in sorted(path.iterdir(), key=_files_first):
                if inner.name not in not_here and not (of_run and _NO_RECORD.fullmatch(inner.name)):
                    yield from _walk(inner, left_out, depth=depth + 1, of_run=of_run)
        elif path.is_file():
            yield path
        else:
            left_out.append(LeftOut(path, "it is not a regular file, but a FIFO, a socket, a device or a broken link"))
    except OSError as error:
        left_out.append(LeftOut(path, f"it cannot be read: {error.strerror}"))


def _files_first(path: Path) -> tuple[bool, int, str]:
    """And 9 before 10."""
    return path.is_dir(), len(path.name), path.name
