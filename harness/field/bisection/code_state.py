"""A state of the code in a directory, and processes that run with it in the place of the installed one."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from harness.errors import InterruptedRunError

ROOT = Path(__file__).parents[3]
"""Of the harness that runs now."""
GRACE_S = 30.0
"""A run that is asked to stop takes its lab down first."""


@dataclass(frozen=True)
class Ended:
    """How a process ended; `status` is None if it took too long and was stopped."""

    status: int | None
    stdout: str
    stderr: str

    @property
    def last_words(self) -> str:
        lines = [line.strip() for line in self.stderr.splitlines() if line.strip()]
        return lines[-1].removeprefix("ucp-harness: ")[:300] if lines else "it said nothing"

    def raised_in(self, directory: Path) -> str | None:
        """The exception that ended it, and the innermost line of `directory` that it came through; None if none did."""
        if "Traceback (most recent call last)" not in self.stderr:
            return None
        frames = re.findall(r'File "([^"\n]+)", line (\d+), in (\S+)', self.stderr)
        ours = [(Path(file), line, name) for file, line, name in frames if Path(file).is_relative_to(directory)]
        if not ours:
            return None
        file, line, name = ours[-1]
        return f"{self.last_words} ({file.relative_to(directory.parent)}:{line}, {name})"


def run_python(
    arguments: Sequence[str], *, first: Sequence[Path], cwd: Path, limit_s: float, stdin: str | None = None
) -> Ended:
    """Run this interpreter with these directories before all other places of modules.

    It has a session of its own, and is stopped in order, then at all events, if whoever waits for it is interrupted.
    """
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, first)),
        "PYTHONDONTWRITEBYTECODE": "1",
        "NO_COLOR": "1",
        "COLUMNS": "200",
    }
    environment.pop("PYTHONHOME", None)
    process = subprocess.Popen(
        [sys.executable, "-P", *arguments],
        cwd=cwd,
        env=environment,
        stdin=subprocess.DEVNULL if stdin is None else subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    try:
        stdout, stderr = process.communicate(stdin, timeout=limit_s)
        return Ended(process.returncode, stdout, stderr)
    except subprocess.TimeoutExpired:
        return Ended(None, "", "")
    finally:
        _stop(process)


def _stop(process: "subprocess.Popen[str]") -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE_S)
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            with suppress(OSError, ValueError):
                stream.close()


@contextmanager
def interrupted_by_sigterm() -> Iterator[None]:
    """What is inside is interrupted by SIGTERM as by Ctrl-C, and leaves nothing behind. Raises InterruptedRunError."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    except KeyboardInterrupt:
        raise InterruptedRunError("interrupted; nothing is left behind") from None
    finally:
        signal.signal(signal.SIGTERM, before)
