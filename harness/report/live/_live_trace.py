"""Follow a growing trace: line by line, through all incarnations of its agent.

An agent as a process writes the trace of each life into a directory of its own (`7.trace.jsonl`, then
`7-2/7.trace.jsonl`), and at the end of the run all is in the first. One in virtual time writes all lives into one file.
"""

import os
from collections import deque
from pathlib import Path

from harness.archive.bounded_file import open_plain_file
from harness.archive.traces import MAX_LINE_BYTES, SUFFIX

_CHUNK_BYTES = 256 * 1024


class GrowingFile:
    """The whole lines of a file, one after another; one that is not there yet has none so far.

    `trouble` says why there will be no more of it, if that is so.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.trouble: str | None = None
        self._file: int | None = None
        self._lines: deque[bytes] = deque()
        self._begun = b""

    def next(self) -> bytes | None:
        """The next line, its end included; None if it is not written yet."""
        while not self._lines:
            if not self._read():
                return None
        return self._lines.popleft()

    def close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _read(self) -> bool:
        """Whether there was more."""
        if self.trouble is not None:
            return False
        try:
            if self._file is None:
                self._file = open_plain_file(self.path)
            data = os.read(self._file, _CHUNK_BYTES)
        except FileNotFoundError:
            return False
        except OSError as error:
            self.trouble = f"cannot be read: {error.strerror}"
            return False
        if not data:
            return False
        *whole, self._begun = (self._begun + data).split(b"\n")
        self._lines.extend(line + b"\n" for line in whole)
        if len(self._begun) > MAX_LINE_BYTES:
            self.trouble, self._begun = f"has a line of more than {MAX_LINE_BYTES // 1024 // 1024} MiB", b""
        return True


class Lives:
    """The lines of one agent's trace, those of later lives after those of earlier ones."""

    def __init__(self, agents: Path, agent_id: int) -> None:
        self._agents, self._agent_id = agents, agent_id
        self._life = 1
        self._headers = 0
        self._file = GrowingFile(agents / f"{agent_id}{SUFFIX}")

    @property
    def trouble(self) -> str | None:
        return self._file.trouble and f"{self._file.path.name} {self._file.trouble}"

    def next(self) -> bytes | None:
        """The next line, its end included; None if it is not written yet."""
        while True:
            line = self._file.next()
            if line is None:
                if not self._later.is_dir():
                    return None
                line = self._file.next()  # by now this life writes nothing more
            elif b'"schema"' in line:
                self._headers += 1
                if self._headers > 1 and self._later.is_dir():
                    line = None  # what follows is of later lives, put together
            if line is not None:
                return line
            self._file.close()
            self._file = GrowingFile(self._later / self._file.path.name)
            self._life, self._headers = self._life + 1, 0

    @property
    def _later(self) -> Path:
        return self._agents / f"{self._agent_id}-{self._life + 1}"

    def close(self) -> None:
        self._file.close()
