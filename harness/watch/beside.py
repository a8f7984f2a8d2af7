"""The page of a run that goes on: its server is a process beside the run, started before it and ended after it."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from harness.errors import MachineError


class Beside:
    """The server's process. `address` is that of the page."""

    def __init__(self, directory: Path, port: int) -> None:
        """Raises MachineError if there can be none: a package is missing, or the port cannot be had."""
        require_packages()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "harness.watch", str(directory), str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C ends the run first
        )
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self.address = self._process.stdout.readline().strip()
        if not self.address:
            last_words = self._process.stderr.read().strip().splitlines() or ["it does not say why"]
            raise MachineError(last_words[-1])

    def run_is_over(self) -> int:
        """Tell the page; how many are open."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write("over\n")
            self._process.stdin.flush()
            return int(self._process.stdout.readline().strip() or 0)
        except (OSError, ValueError):
            return 0  # it has failed, which is no affair of the run's

    def wait(self) -> None:
        """Until nobody looks any more, or Ctrl-C."""
        with suppress(KeyboardInterrupt):
            self._process.wait()

    def close(self) -> None:
        self._process.terminate()
        self._process.communicate()


@contextmanager
def beside(directory: Path, port: int) -> Iterator[Beside]:
    """A server for the run that is about to begin in that directory. Raises MachineError if there can be none."""
    server = Beside(directory, port)
    try:
        yield server
    finally:
        server.close()


def require_packages() -> None:
    """Raises MachineError, with the way out, if what the server needs is not installed."""
    try:
        import aiohttp  # noqa: F401
    except ImportError:
        raise MachineError("watching a run takes a further package: `pip install ucp-harness[watch]`") from None
