"""Run a program that plays agents in virtual time, and keep a pool of such programs for reuse.

The harness writes one line to the program's standard input and reads one line as its answer, as the contract describes
for `--virtual`. The program has a few seconds of wall time for each answer. It does not receive Ctrl-C. It ends when
the thread that started it ends.

Starting a program takes longer than playing a short mission, so a pool keeps them for the next mission. Each process
of the harness has a pool of its own. A forked child starts with an empty pool.
"""

import atexit
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
from threading import Lock
from typing import IO

from harness.archive.exports import MAX_EXPORT_BYTES
from harness.play.agent_control import TAIL_BYTES, last_line, last_line_in
from harness.play.child_processes import ChildProcesses
from harness.play.simulation.foreign._answer import Outcome

START_LIMIT_S = 30.0
ANSWER_LIMIT_S = 10.0
"""Wall time after which a program that does not answer counts as hung. The first answer may take `START_LIMIT_S`."""
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

    Its standard error goes to `log`. Without `log`, it goes to a temporary file that each mission clears. Raises
    OSError if the program cannot be started.
    """

    def __init__(self, command: Sequence[str], log: Path | None = None) -> None:
        self.command = tuple(command)
        self.log = log
        self.owes_an_answer = False
        self._answered = False
        self._received = b""
        self._processes = ChildProcesses()
        self.left_behind: list[str] = []
        """Names of the child processes that remained after the program's end."""
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
        """Read a line that arrives in several pieces to its end, and return the whole line."""
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
        """Return the last line of the program's standard error. Return an empty string if there is none."""
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

    def close_input(self) -> None:
        """Close the standard input of the program. The program then ends."""
        with suppress(OSError):
            assert self._process.stdin is not None
            self._process.stdin.close()

    def end(self, within_s: float = 0.0) -> None:
        """End the program and its child processes. After `within_s` seconds, kill them with SIGKILL."""
        self.close_input()
        try:
            self._process.wait(within_s)
        except subprocess.TimeoutExpired:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)  # the process group includes the children of a script
            self._process.wait()
            self._processes.end_left_behind()
        else:
            self.left_behind = self._processes.end_left_behind()
        self.release()

    def close(self) -> None:
        """Kill the program at once."""
        self.end()

    def release(self) -> None:
        """Close the pipes and files that this process uses for the program. Do not kill the program."""
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


MAX_IDLE = 128
"""Maximum number of idle programs. A further one ends the program that has been idle for the longest time."""
GRACE_S = 1.0


class ProgramPool:
    """A pool of idle programs for reuse.

    Standard error of a program goes to a file for each agent in the directory `logs`. With None, only error messages
    use it.
    """

    def __init__(self, logs: Path | None = None) -> None:
        self._logs = logs
        self._idle: list[LineProgram] = []
        """Idle programs, the longest idle one first."""
        self._taken: set[LineProgram] = set()
        self._lock = Lock()

    def take(self, command: Sequence[str], agent_id: int) -> LineProgram:
        """Return an idle or a new program, which the caller must give back. Raises OSError if a new program cannot be
        started.
        """
        log = self._logs / f"{agent_id}.log" if self._logs is not None else None
        with self._lock:
            program = self._idle_program(tuple(command), log) or LineProgram(command, log)
            self._taken.add(program)
        return program

    def _idle_program(self, command: tuple[str, ...], log: Path | None) -> LineProgram | None:
        for program in reversed(self._idle):
            if (program.command, program.log) == (command, log):
                self._idle.remove(program)
                if program.runs:
                    return program
                program.close()
                return self._idle_program(command, log)
        return None

    def give_back(self, program: LineProgram) -> None:
        """Return the program to the pool. If it has not answered its last input, end it instead."""
        with self._lock:
            self._taken.discard(program)
            if program.owes_an_answer:
                program.close()
                return
            program.clear_output()
            self._idle.append(program)
            if len(self._idle) > MAX_IDLE:
                self._idle.pop(0).close()

    def close(self) -> dict[int, list[str]]:
        """End all programs. Return, by agent, the names of processes that a program with a log left behind."""
        programs = [*self._taken, *self._idle]
        self._taken.clear()
        self._idle.clear()
        for program in programs:
            program.close_input()
        deadline = time.monotonic() + GRACE_S
        for program in programs:
            program.end(max(0.0, deadline - time.monotonic()))
        return {int(each.log.stem): each.left_behind for each in programs if each.log is not None and each.left_behind}

    def release_all(self) -> None:
        """Empty the pool without ending the programs, because they belong to the parent process."""
        for program in [*self._taken, *self._idle]:
            program.release()
        self._taken.clear()
        self._idle.clear()
        self._lock = Lock()


SHARED = ProgramPool()
"""The pool for missions in memory. A sweep plays thousands of them."""

atexit.register(SHARED.close)
os.register_at_fork(after_in_child=SHARED.release_all)
