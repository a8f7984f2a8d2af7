"""Follow a growing trace file line by line, including all restarts of its agent.

An agent that is a process writes the trace of each incarnation into its own directory (`7.trace.jsonl`, then
`7-2/7.trace.jsonl`). At the end of the run, the traces of all incarnations are joined in the first file. In virtual
time, all incarnations use one file from the start.
"""

from collections import deque
from collections.abc import Callable
from pathlib import Path

from harness.archive.bounded_file import BoundedFile
from harness.archive.trace_files import open_trace, trace_file
from harness.archive.traces import MAX_LINE_BYTES

_CHUNK_BYTES = 256 * 1024


class GrowingFile:
    """The complete lines of a file that still grows. The file may be created after this object.

    `trouble` is the reason why no further lines can be read, or None.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.trouble: str | None = None
        self._file: BoundedFile | None = None
        self._lines: deque[bytes] = deque()
        self._partial_line = b""

    def next(self) -> bytes | None:
        """Return the next line without its line end. Return None if the next line is not complete yet."""
        while not self._lines:
            if not self._read():
                return None
        return self._lines.popleft()

    def drop_while(self, can_be_dropped: Callable[[bytes], bool]) -> bytes | None:
        """Drop lines that were read but not returned yet. Stop at the first line for which `can_be_dropped` returns
        false. Return the last dropped line.
        """
        dropped, lines = None, self._lines
        while lines and can_be_dropped(lines[0]):
            dropped = lines.popleft()
        return dropped

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def _read(self) -> bool:
        """Read the next part of the file. Return true if the file contained new data."""
        if self.trouble is not None:
            return False
        try:
            if self._file is None:
                self._file = open_trace(self.path)
            data = self._file.read(_CHUNK_BYTES)
        except FileNotFoundError:
            return False
        except OSError as error:
            self.trouble = f"cannot be read: {error.strerror}"
            return False
        if not data:
            if self._file.problem:
                self.trouble = f"breaks off: {self._file.problem}"
            return False
        *complete, self._partial_line = (self._partial_line + data).split(b"\n")
        self._lines.extend(complete)
        if len(self._partial_line) > MAX_LINE_BYTES:
            self.trouble, self._partial_line = f"has a line of more than {MAX_LINE_BYTES // 1024 // 1024} MiB", b""
        return True


class AgentTrace:
    """A reader for the lines of one agent's trace, in all incarnations of the agent."""

    def __init__(self, agents: Path, agent_id: int) -> None:
        self._agents, self._agent_id = agents, agent_id
        self._incarnation = 1
        self._headers = 0
        self._file = GrowingFile(trace_file(agents, agent_id))

    @property
    def trouble(self) -> str | None:
        return self._file.trouble and f"{self._file.path.name} {self._file.trouble}"

    def next(self) -> bytes | None:
        """Return the next line without its line end. Return None if the next line is not complete yet."""
        while True:
            line = self._file.next()
            if line is None:
                if not self._later.is_dir():
                    return None
                line = self._file.next()  # the next incarnation has begun, so this one writes nothing more
            elif b'"schema"' in line:
                self._headers += 1
                if self._headers > 1 and self._later.is_dir():
                    line = None  # the run has ended: the rest of this file repeats the later incarnations
            if line is not None:
                return line
            self._file.close()
            self._file = GrowingFile(trace_file(self._later, self._agent_id))
            self._incarnation, self._headers = self._incarnation + 1, 0

    def drop_while(self, can_be_dropped: Callable[[bytes], bool]) -> bytes | None:
        """Drop lines of the current incarnation. Stop at the first line for which `can_be_dropped` returns false.
        Return the last dropped line.
        """
        return self._file.drop_while(can_be_dropped)

    @property
    def _later(self) -> Path:
        return self._agents / f"{self._agent_id}-{self._incarnation + 1}"

    def close(self) -> None:
        self._file.close()
