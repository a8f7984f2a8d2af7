"""A trace as it stands, line by line, for whoever compares what was written: it can have hundreds of thousands."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeVar

from pydantic import TypeAdapter

from harness.archive.traces import ASIDE, HANDLER_RUN, HEADER, MAX_LINE_BYTES
from harness.errors import RunDirectoryError
from ucp.trace import HandlerRun

Record = TypeVar("Record")


class Line(NamedTuple):
    """A handler run as it stands in a trace; lines and lives count from 1."""

    path: Path
    number: int
    life: int
    text: bytes

    def parsed(self) -> HandlerRun:
        """Raises RunDirectoryError if it is none."""
        return _validated(HANDLER_RUN, self.path, self.number, self.text)


def read_lines(path: Path) -> Iterator[Line]:
    """The handler runs of a trace; half a last line, over which an agent was killed, is none.

    Raises RunDirectoryError, when it comes there, if the file cannot be read or a line is not what it should be.
    """
    life = number = 0
    try:
        with path.open("rb") as file:
            while text := file.readline(MAX_LINE_BYTES):
                number += 1
                if not text.endswith(b"\n") and len(text) < MAX_LINE_BYTES:
                    break
                if life and b'"handler"' in text:
                    yield Line(path, number, life, text)
                elif life and b'"schema"' not in text:
                    _validated(ASIDE, path, number, text)
                else:
                    _validated(HEADER, path, number, text)
                    life += 1
    except OSError as error:
        raise RunDirectoryError(
            f"{path}: cannot be read ({error.strerror}), and runs are compared by their traces: play the run again"
        ) from None
    if not life:
        raise RunDirectoryError(f"{path}: it is empty, and runs are compared by their traces: play the run again")


def _validated(kind: TypeAdapter[Record], path: Path, number: int, text: bytes) -> Record:
    try:
        return kind.validate_json(text)
    except ValueError:
        raise RunDirectoryError(
            f"{path}: line {number} is damaged, or of another version of traces: play the run again"
        ) from None
