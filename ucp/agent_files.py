"""What an agent leaves on disk: its chain export, written whole or not at all, its trace and its log, line by line."""

import contextlib
import json
import os
import time
from pathlib import Path
from typing import Any, BinaryIO

CHUNK_BYTES = 64 * 1024


def write_json_atomically(path: Path, document: dict[str, Any]) -> None:
    """Write JSON as `write_atomically` does."""
    write_atomically(path, json.dumps(document, indent=1) + "\n")


def write_atomically(path: Path, text: str) -> None:
    """Write so that `path` holds either the old text or all of the new. Raises OSError (disk full, ...).

    Half a character, which JSON can hold and UTF-8 cannot, is written as a question mark.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("w", encoding="utf-8", errors="replace") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


class LogFile:
    """Appends what the agent has to say to people, a line each; one that the disk refuses is lost."""

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("ab", buffering=0)

    def say(self, sentence: str) -> None:
        now = time.time()
        at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(now))
        with contextlib.suppress(OSError):
            self._file.write(f"{at},{int(now % 1 * 1000):03d} {sentence}\n".encode(errors="replace"))

    def close(self) -> None:
        self._file.close()


class TraceFile:
    """Appends whole lines; once the disk refuses one, stops for good and keeps what was written.

    Half a line, over which an earlier life of the agent was killed, is cut away. `problem` says why
    it stopped, so that a trace that ends early is not mistaken for an agent that fell silent.
    """

    def __init__(self, path: Path) -> None:
        self.problem: str | None = None
        self._file: BinaryIO = path.open("a+b", buffering=0)
        end = _end_of_last_line(self._file)
        if self._file.seek(0, os.SEEK_END) > end:
            self._file.truncate(end)
            self._file.seek(end)

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


def _end_of_last_line(file: BinaryIO) -> int:
    """Where the last whole line of the file ends; 0 if it has none."""
    end = file.seek(0, os.SEEK_END)
    while end:
        begin = max(0, end - CHUNK_BYTES)
        file.seek(begin)
        newline = file.read(end - begin).rfind(b"\n")
        if newline >= 0:
            return begin + newline + 1
        end = begin
    return 0
