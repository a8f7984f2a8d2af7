"""What an agent leaves on disk: its chain export, written whole or not at all, and its trace, line by line."""

import contextlib
import json
import os
from pathlib import Path
from typing import Any, BinaryIO


def write_atomically(path: Path, document: dict[str, Any]) -> None:
    """Write JSON so that `path` holds either the old document or all of the new. Raises OSError (disk full, ...)."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("w", encoding="ascii") as file:
            json.dump(document, file, indent=1)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


class TraceFile:
    """Appends whole lines; once the disk refuses one, stops for good and keeps what was written.

    `problem` then says why, so that a trace that ends early is not mistaken for an agent that fell silent.
    """

    def __init__(self, path: Path) -> None:
        self.problem: str | None = None
        self._file: BinaryIO = path.open("ab", buffering=0)

    def write(self, lines: str) -> None:
        if self.problem is not None or not lines:
            return
        data = lines.encode("ascii")
        end = self._file.tell()
        try:
            if self._file.write(data) == len(data):
                return
            self.problem = "No space left on device"
        except OSError as error:
            self.problem = error.strerror or str(error)
        with contextlib.suppress(OSError):
            self._file.truncate(end)

    def close(self) -> None:
        self._file.close()
