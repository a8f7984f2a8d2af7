"""Manage the live page of an active run. The web server of the page is a separate process.

The two processes exchange lines of JSON. The process of the run sends `["t", mission second]`, `["hand", state]` and
answers to requests. The server first sends the page's address, and then `[page, number, request]` for each request.
"""

import json
import queue
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import IO, Any

from harness.errors import HarnessError, MachineError, extra
from harness.play.interventions import Interventions
from harness.play.progress import ProgressDisplay, SwarmSnapshot

STATE_EVERY_S = 0.1
LAST_LOOK_S = 60.0
"""Maximum wall time after the run, in seconds, in which the server reads the rest of the run and reports the number of
open pages.
"""
ENDING_S = 5.0
MAX_OUTGOING = 10_000
"""Maximum number of lines that wait for the server. If the server hangs, further lines are lost."""
_LAST_LINES = 20
_NO_REASON = "it does not say why"


class LivePage:
    """The process of the web server that serves the live page. The process forwards requests from browsers. `address`
    is the address of the page.

    The run never waits for the server. Threads write to the server and read from it.
    """

    def __init__(self, directory: Path, port: int, interventions: Interventions) -> None:
        """Start the server. Raises MachineError if a package is missing or the port is not available."""
        require_packages()
        self._interventions = interventions
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "harness.report.live", str(directory), str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,  # Ctrl-C must reach the run first
        )
        self._last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._error_reader = _thread(self._read_errors)
        self.address = _required(self._process.stdout).readline().strip()
        if not self.address:
            self.close()
            raise MachineError(self._last_error)
        self._ended = threading.Event()
        self._outgoing: queue.Queue[list[Any] | None] = queue.Queue(MAX_OUTGOING)
        self._readers: int | None = None
        self._snapshot: SwarmSnapshot | None = None
        self._writer, self._reader = _thread(self._write_lines), _thread(self._read_requests)
        self._state_sender = _thread(self._send_state)
        self.problem: str | None = None
        """A sentence that reports that the server ended before the end of the run, or None if there was no problem."""

    def tee(self, progress: ProgressDisplay) -> ProgressDisplay:
        """Return a progress display that forwards all progress to `progress` and also updates the page."""
        return _ProgressTee(progress, self)

    def set_snapshot(self, snapshot: SwarmSnapshot) -> None:
        self._snapshot = snapshot

    def run_is_over(self) -> bool:
        """Report to the web server that the run has ended. Return true if a page is open."""
        self._ended.set()
        self._state_sender.join()
        self._send(["over"])
        self._reader.join(LAST_LOOK_S)
        if self._reader.is_alive():
            self.problem = f"the page hung: its server did not answer within {LAST_LOOK_S:g} s after the run"
        elif self._readers is None:
            from netem.lab import in_words  # imported late, because the import is slow

            end = in_words(self._process.wait())
            self._error_reader.join(ENDING_S)  # the thread may not have read the last line yet
            self.problem = f"the server of the page ended by itself with {end} ({self._last_error}); the run continued"
        return bool(self._readers)

    def wait(self) -> None:
        """Wait until all pages are closed, or until the user presses Ctrl-C."""
        with suppress(KeyboardInterrupt):
            self._process.wait()

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._error_reader.join()
        if self.address:
            self._ended.set()
            self._state_sender.join()
            self._outgoing.put(None)
            self._writer.join()
            self._reader.join()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            with suppress(OSError):
                _required(stream).close()

    @property
    def _last_error(self) -> str:
        return self._last_lines[-1] if self._last_lines else _NO_REASON

    def _read_errors(self) -> None:
        """Read the error output of the web server. Without a reader, a full pipe would block the server."""
        for line in _required(self._process.stderr):
            if line.strip():
                self._last_lines.append(line.strip())

    def _send(self, what: list[Any]) -> None:
        """Queue a line for the web server, and return without waiting. A failed or hung server must not affect the
        run.
        """
        with suppress(queue.Full):
            self._outgoing.put_nowait(what)

    def _write_lines(self) -> None:
        to = _required(self._process.stdin)
        while (what := self._outgoing.get()) is not None:
            with suppress(OSError, ValueError):
                to.write(json.dumps(what) + "\n")
                to.flush()

    def _read_requests(self) -> None:
        for line in _required(self._process.stdout):
            message = json.loads(line)
            if isinstance(message, int):
                self._readers = message
                return
            page, number, request = message
            try:
                answer = _perform(self._interventions, request)
            except (ValueError, TypeError, KeyError, AttributeError):
                self._send(["answer", page, number, {"error": "that cannot be asked for"}])
                continue
            answer.add_done_callback(partial(self._answer, page, number))

    def _answer(self, page: int, number: Any, done: Future[float]) -> None:
        error = done.exception()
        if error is not None and not isinstance(error, HarnessError):
            error = MachineError(_NO_REASON)
        self._send(["answer", page, number, {"at_s": done.result()} if error is None else {"error": str(error)}])

    def _send_state(self) -> None:
        """Send the mission second and the state of the controls to the web server whenever they change."""
        before: tuple[Any, ...] = ()
        now_s = -1.0
        while not self._ended.wait(STATE_EVERY_S):
            interventions, snapshot = self._interventions, self._snapshot
            stage = snapshot.stage if snapshot else "starting"
            state = (
                interventions.pace is not None,
                interventions.paused,
                interventions.factor,
                interventions.closed,
                stage,
            )
            if state != before:
                before = state
                keys = ("virtual", "paused", "factor", "closed", "stage")
                self._send(["hand", dict(zip(keys, state, strict=True))])
            if snapshot is not None and snapshot.mission_s > now_s:
                now_s = snapshot.mission_s
                self._send(["t", round(now_s, 3)])


class _ProgressTee:
    """A progress display that also updates the live page."""

    def __init__(self, progress: ProgressDisplay, live_page: LivePage) -> None:
        self._progress, self._page = progress, live_page

    def show(self, snapshot: SwarmSnapshot) -> None:
        self._page.set_snapshot(snapshot)
        self._progress.show(snapshot)

    def show_judging(self, step: str) -> None:
        self._progress.show_judging(step)

    def close(self) -> None:
        self._progress.close()


def _thread(run: Callable[[], None]) -> threading.Thread:
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def _required(stream: IO[str] | None) -> IO[str]:
    assert stream is not None, "we asked for a pipe"
    return stream


def _perform(interventions: Interventions, request: dict[str, Any]) -> Future[float]:
    """Carry out a request that a page sent. Raises ValueError, TypeError, KeyError or AttributeError if the request is
    invalid.
    """
    match request["do"]:
        case "happen":
            return interventions.ask(request["entry"])
        case "pause":
            return interventions.pause()
        case "go on":
            return interventions.resume()
        case "step":
            return interventions.step(float(request["seconds"]))
        case "next run":
            return interventions.step_to_next_run()
        case "speed":
            return interventions.set_factor(None if request["factor"] is None else float(request["factor"]))
        case _:
            raise ValueError("the request is unknown")


@contextmanager
def live_page(directory: Path, port: int, interventions: Interventions) -> Iterator[LivePage]:
    """Run a web server for the run in this directory while the context is open. Raises MachineError if the server
    cannot be started.
    """
    server = LivePage(directory, port, interventions)
    try:
        yield server
    finally:
        server.close()


def require_packages() -> None:
    """Raise MachineError if a package that the server needs is missing. The error contains the install command."""
    with extra("watch", "watching a run"):
        import aiohttp  # noqa: F401
