"""Traces as steps to compare, read line by line: a trace can have hundreds of thousands of lines."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeVar

from pydantic import TypeAdapter

from harness.archive.traces import HANDLER_RUN, HEADER, MAX_LINE_BYTES
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


@dataclass(frozen=True)
class Step:
    """A handler run as two runs are compared by it; `t`, in mission seconds, and `line` only say where it is.

    `changes` are (operation, block), `sent` are (message, block), and a block is its name, None for no block.
    """

    life: int
    handler: str
    branch: str
    trigger: dict[str, int | str]
    changes: tuple[tuple[str, str], ...]
    sent: tuple[tuple[str, str | None], ...]
    t: float = field(compare=False)
    line: int = field(compare=False)

    @classmethod
    def of(cls, line: Line, names: Mapping[str, str]) -> "Step":
        """`names` are those of the blocks by hash; one that has none goes by the beginning of its hash."""
        run = line.parsed()
        return cls(
            line.life,
            run.handler,
            run.branch,
            run.trigger,
            tuple((operation, name(block, names)) for operation, block in run.changes),
            tuple((sent.message, sent.block and name(sent.block, names)) for sent in run.sent),
            run.t,
            line.number,
        )


def name(block_hash: str, names: Mapping[str, str]) -> str:
    return names.get(block_hash, block_hash[:12])


def completed_blocks(path: Path, agent_id: int) -> dict[str, str]:
    """Hash -> `<agent>.<ordinal>` of each block that the agent completed, in all its lives."""
    names: dict[str, str] = {}
    for line in read_lines(path):
        if b'"complete"' in line.text:
            for operation, block in line.parsed().changes:
                if operation == "complete":
                    names.setdefault(block, f"{agent_id}.{len(names) + 1}")
    return names


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
                if life and b'"schema"' not in text:
                    yield Line(path, number, life, text)
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
