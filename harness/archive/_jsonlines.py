"""Reading JSON Lines files that anybody may have left: line by line, within bounds, whatever they hold."""

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Generic, TypeVar

from pydantic import BaseModel, ValidationError

MAX_LINES = 50_000
MAX_BYTES = 32 * 1024 * 1024
"""Tracks of 50 vehicles take 1.6 MB for 20 minutes."""
MAX_LINE_BYTES = 4 * 1024 * 1024

Record = TypeVar("Record", bound=BaseModel)


class JsonLines(Generic[Record]):
    """The lines of a file that are what `model` says. A file that is not there, or nowhere (None), has none."""

    def __init__(self, path: Path | None, model: type[Record]) -> None:
        self._path, self._model = path, model
        self._left_out = 0
        self._trouble = ""

    def __iter__(self) -> Iterator[Record]:
        if self._path is None or not self._path.is_file():
            return
        try:
            with self._path.open("rb") as file:
                for number in count(1):
                    if not (line := file.readline(MAX_LINE_BYTES)):
                        return
                    if number > MAX_LINES or file.tell() > MAX_BYTES:
                        self._trouble = (
                            f"what is beyond {MAX_LINES} lines or {MAX_BYTES // 1024 // 1024} MiB is left out"
                        )
                        return
                    if len(line) == MAX_LINE_BYTES and not line.endswith(b"\n"):
                        self._trouble = (
                            f"what follows {MAX_LINE_BYTES // 1024 // 1024} MiB without a line's end is left out"
                        )
                        return
                    try:
                        read = self._model.model_validate_json(line)
                    except ValidationError:
                        self.leave_out()
                    else:
                        yield read
        except OSError as error:
            self._trouble = f"cannot be read: {error.strerror}"

    def leave_out(self) -> None:
        """The last line means nothing after all."""
        self._left_out += 1

    def problems(self) -> list[str]:
        """A sentence, for people, on each thing that was wrong with what was read."""
        troubles = []
        if self._left_out:
            lines = "1 line is" if self._left_out == 1 else f"{self._left_out} lines are"
            troubles.append(f"{lines} left out, damaged or of no meaning")
        if self._trouble:
            troubles.append(self._trouble)
        return [f"{self._path.name if self._path else ''}: {trouble}" for trouble in troubles]
