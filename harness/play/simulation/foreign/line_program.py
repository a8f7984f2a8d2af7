"""Exchange lines with a program that runs agents in virtual time.

The harness writes one line to the program's standard input and reads one line as its answer, as the contract describes
for `--virtual`. The program has a few seconds of wall time for each answer. It does not receive Ctrl-C. It ends when
the thread that started it ends.
"""

import os
import select
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from ctypes import CDLL
from pathlib import Path
from typing import IO

from harness.archive.exports import MAX_EXPORT_BYTES
from harness.play._child_processes import ChildProcesses
from harness.play.agent_control import TAIL_BYTES, last_line, last_line_in
from harness.play.simulation.foreign._answer import Outcome

START_LIMIT_S = 30.0
ANSWER_LIMIT_S = 10.0
"""A program counts as hung if it sends no answer for this number of seconds of wall time. The first answer may take
`START_LIMIT_S`.
"""
MAX_ANSWER_BYTES = MAX_EXPORT_BYTES
CHUNK_BYTES = 64 * 1024
END_LIMIT_S = 1.0

_PR_SET_PDEATHSIG = 1
_LIBC = CDLL(None)


class ProgramFailedError(Exception):
    """An error: a program ended, hung, or wrote an invalid line. The message completes a sentence that starts with
    "agent 3".
    """

    def __init__(self, outcome: Outcome, what: str, status: int | None = None) -> None:
        super().__init__(what)
        self.outcome: Outcome = outcome
        self.status = status
        """Exit status of the program, if it ended by itself."""


class LineProgram:
    """A running program that was started with `command` and the argument `--virtual`.

    The standard error of the program goes to the file `log`. If `log` is None, it goes to a temporary file, which is
    cleared at the start of each mission. Raises OSError if the program cannot be started.
    """

    def __init__(self, command: Sequence[str], log: Path | None = None) -> None:
        self.command = tuple(command)
        self.log = log
        self.owes_an_answer = False
        self._answered = False
        self._received = b""
        self._processes = ChildProcesses()
        self.left_behind: list[str] = []
        """Names of the child processes that still ran after the program's end."""
        self._errors: IO[bytes] = log.open("ab") if log is not None else _temporary_file()
        try:
            self._process = subprocess.Popen(
                [*command, "--virtual"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                bufsize=0,
                cwd=tempfile.gettempdir(),
                env=self._processes.environment(os.environ),
                process_group=0,
                preexec_fn=_die_with_parent,
            )
        except BaseException:
            self._errors.close()
            raise
        assert self._process.stdin is not None and self._process.stdout is not None
        self._in, self._out = self._process.stdin.fileno(), self._process.stdout.fileno()
        os.set_blocking(self._in, False)
        self._readable = select.poll()
        self._readable.register(self._out, select.POLLIN)

    @property
    def is_new(self) -> bool:
        """True if the program has not answered yet."""
        return not self._answered

    @property
    def runs(self) -> bool:
        return self._process.poll() is None

    def write(self, line: bytes) -> None:
        """Write a line to the program. Raises ProgramFailedError."""
        if self._received:
            raise ProgramFailedError("crashed", f"wrote an unexpected line: {_shown(self._received)}")
        self.owes_an_answer = True
        try:
            written = os.write(self._in, line)
        except BlockingIOError:
            written = 0
        except BrokenPipeError:
            raise self._end_error() from None
        if written < len(line):
            self._write_rest(memoryview(line)[written:])

    def read(self) -> bytes:
        """Read the next line from the program, including its line end. Raises ProgramFailedError."""
        limit_s = ANSWER_LIMIT_S if self._answered else START_LIMIT_S
        if not self._received:
            if not self._readable.poll(limit_s * 1000):
                raise _hung_error(limit_s)
            self._received = os.read(self._out, CHUNK_BYTES)
            if not self._received:
                raise self._end_error()
        end = self._received.find(b"\n") + 1
        line = self._received[:end] if end else self._read_rest(limit_s)
        self._received = self._received[len(line) :]
        self._answered, self.owes_an_answer = True, False
        return line

    def _read_rest(self, limit_s: float) -> bytes:
        """Read the rest of a line that arrives in several pieces, and return the whole line."""
        deadline = time.monotonic() + limit_s
        pieces = [self._received]
        length = len(self._received)
        while b"\n" not in pieces[-1]:
            if length > MAX_ANSWER_BYTES:
                raise ProgramFailedError("crashed", f"answers with a line of more than {MAX_ANSWER_BYTES >> 20} MiB")
            left_s = deadline - time.monotonic()
            if left_s <= 0 or not self._readable.poll(left_s * 1000):
                raise _hung_error(limit_s)
            pieces.append(os.read(self._out, CHUNK_BYTES))
            length += len(pieces[-1])
            if not pieces[-1]:
                raise self._end_error()
        self._received = b"".join(pieces)
        return self._received[: self._received.find(b"\n") + 1]

    def _write_rest(self, left: memoryview) -> None:
        """Write the remaining bytes of a line when the pipe is full. Also read output of the program, so that it can
        continue.
        """
        deadline = time.monotonic() + ANSWER_LIMIT_S
        ready = select.poll()
        ready.register(self._in, select.POLLOUT)
        ready.register(self._out, select.POLLIN)
        while left:
            left_s = deadline - time.monotonic()
            events = dict(ready.poll(max(0.0, left_s) * 1000))
            if not events:
                raise ProgramFailedError("hung", f"did not read its input within {ANSWER_LIMIT_S:g} s")
            if self._out in events:
                output = os.read(self._out, CHUNK_BYTES)
                self._received += output
                if not output or len(self._received) > MAX_ANSWER_BYTES:
                    raise self._end_error() if not output else ProgramFailedError("crashed", "writes without end")
            if self._in in events:
                with suppress(BlockingIOError):
                    try:
                        left = left[os.write(self._in, left) :]
                    except BrokenPipeError:
                        raise self._end_error() from None

    def _end_error(self) -> ProgramFailedError:
        try:
            status = self._process.wait(END_LIMIT_S)
        except subprocess.TimeoutExpired:
            return ProgramFailedError("crashed", "closed its standard input or output and did not end")
        if status < 0:
            return ProgramFailedError("crashed", f"was ended by {signal.Signals(-status).name}")
        return ProgramFailedError("crashed", f"ended by itself with status {status}", status)

    def log_phrase(self) -> str:
        """Return the end of an error message: the path of the program's log, or the last line of its output."""
        if self.log is not None:
            return f"; its log is {self.log}"
        words = self.last_line()
        return f"; its last output: {words}" if words else ""

    def last_line(self) -> str:
        """Return the last line of the program's standard error. Return an empty string if it has no line."""
        if self.log is not None:
            return last_line_in(self.log)
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - TAIL_BYTES))
        return last_line(self._errors.read().decode("utf-8", "replace"))

    def clear_output(self) -> None:
        """Discard the standard error of a finished mission, unless it is written to a log."""
        if self.log is None:
            self._errors.seek(0)
            self._errors.truncate()

    def exchange(self, line: bytes) -> bytes:
        """Write a line to the program, and return its answer. Raises ProgramFailedError."""
        self.write(line)
        return self.read()

    def close_input(self) -> None:
        """Close the standard input of the program. The program then ends."""
        with suppress(OSError):
            assert self._process.stdin is not None
            self._process.stdin.close()

    def finish(self, within_s: float) -> int | None:
        """Close the standard input of the program, and return its exit status. Return None if the program still runs
        after `within_s` seconds.
        """
        self.close_input()
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(within_s)
        return None

    def kill(self) -> None:
        """Kill the program and all other processes of its process group with SIGKILL. If the program is a script, these
        include the processes that the script started.
        """
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def end(self, within_s: float = 0.0) -> None:
        """End the program and its child processes. After `within_s` seconds, kill them with SIGKILL."""
        if self.finish(within_s) is None:
            self.kill()
            self._processes.end_left_behind()
        else:
            self.left_behind = self._processes.end_left_behind()
        self.release()

    def close(self) -> None:
        """Kill the program at once."""
        self.end()

    def release(self) -> None:
        """Close the pipes and files with which this process uses the program. The program continues."""
        self.close_input()
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._errors.close()


def _hung_error(limit_s: float) -> ProgramFailedError:
    return ProgramFailedError("hung", f"did not answer within {limit_s:g} s (with a whole line, flushed)")


def _temporary_file() -> IO[bytes]:
    return tempfile.TemporaryFile()  # the caller closes it


def _die_with_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _shown(output: bytes) -> str:
    text = output.split(b"\n")[0].decode(errors="replace")
    return repr(text[:60] + ("..." if len(text) > 60 else ""))
