"""An agent's trace while it is written: line by line, through all of its lives.

An agent as a process writes the trace of each life into a directory of its own (`7.trace.jsonl`, then
`7-2/7.trace.jsonl`), and at the end of the run all is in the first. One in virtual time writes all lives into one file.
"""

from pathlib import Path

from harness.archive.traces import SUFFIX
from harness.report.live.growing_file import GrowingFile


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
