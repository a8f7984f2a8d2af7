"""The page of a live run. Its server is a separate process, started before the run and stopped after it.

The two processes exchange lines of JSON. The run sends `["t", mission second]`, `["hand", state]` and answers to
requests. The server first sends the page's address, and then `[page, number, request]` for each request.
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

from harness.errors import HarnessError, MachineError
from harness.play.interventions import Interventions
from harness.play.progress import Progress, Snapshot

STATE_EVERY_S = 0.1
LAST_LOOK_S = 60.0
"""Maximum wall time in which the server reads the rest of a run, and reports the number of open pages."""
ENDING_S = 5.0
MOST_WAITING = 10_000
"""Maximum number of unsent lines. Further lines are lost, because the server hangs."""
_LAST_LINES = 20
_NO_REASON = "it does not say why"


class Beside:
    """The process of the server, and the requests that it forwards from pages. `address` is the address of the page.

    The run never waits for the server. Threads write to the server and read from it.
    """

    def __init__(self, directory: Path, port: int, hand: Interventions) -> None:
        """Start the server. Raises MachineError if a package is missing or the port is not available."""
        require_packages()
        self._hand = hand
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
        self._complaining = _thread(self._hear_complaints)
        self.address = _of(self._process.stdout).readline().strip()
        if not self.address:
            self.close()
            raise MachineError(self._last_words)
        self._ended = threading.Event()
        self._unsaid: queue.Queue[list[Any] | None] = queue.Queue(MOST_WAITING)
        self._readers: int | None = None
        self._snapshot: Snapshot | None = None
        self._saying, self._hearing = _thread(self._say_all), _thread(self._hear)
        self._telling_state = _thread(self._tell_state)
        self.problem: str | None = None
        """After the run: a sentence about an early end of the server, or None."""

    def overhears(self, progress: Progress) -> Progress:
        """Return a progress display that also informs the page."""
        return _Overheard(progress, self)

    def shows(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot

    def run_is_over(self) -> bool:
        """Inform the server that the run is over. Return whether a page is open."""
        self._ended.set()
        self._telling_state.join()
        self._say(["over"])
        self._hearing.join(LAST_LOOK_S)
        if self._hearing.is_alive():
            self.problem = f"the page hung: its server did not answer within {LAST_LOOK_S:g} s after the run"
        elif self._readers is None:
            from netem.lab import in_words  # imported late, because the import is slow

            end = in_words(self._process.wait())
            self._complaining.join(ENDING_S)  # the thread may not have read the last line yet
            self.problem = f"the server of the page ended by itself with {end} ({self._last_words}); the run continued"
        return bool(self._readers)

    def wait(self) -> None:
        """Wait until all pages are closed, or until Ctrl-C."""
        with suppress(KeyboardInterrupt):
            self._process.wait()

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._complaining.join()
        if self.address:
            self._ended.set()
            self._telling_state.join()
            self._unsaid.put(None)
            self._saying.join()
            self._hearing.join()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            with suppress(OSError):
                _of(stream).close()

    @property
    def _last_words(self) -> str:
        return self._last_lines[-1] if self._last_lines else _NO_REASON

    def _hear_complaints(self) -> None:
        """Read the errors of the server. Without a reader, a full pipe would block the server."""
        for line in _of(self._process.stderr):
            if line.strip():
                self._last_lines.append(line.strip())

    def _say(self, what: list[Any]) -> None:
        """Queue a line. A failed or hung server must not affect the run."""
        with suppress(queue.Full):
            self._unsaid.put_nowait(what)

    def _say_all(self) -> None:
        to = _of(self._process.stdin)
        while (what := self._unsaid.get()) is not None:
            with suppress(OSError, ValueError):
                to.write(json.dumps(what) + "\n")
                to.flush()

    def _hear(self) -> None:
        for line in _of(self._process.stdout):
            heard = json.loads(line)
            if isinstance(heard, int):
                self._readers = heard
                return
            page, number, asked = heard
            try:
                answer = _do(self._hand, asked)
            except (ValueError, TypeError, KeyError, AttributeError):
                self._say(["answer", page, number, {"error": "that cannot be asked for"}])
                continue
            answer.add_done_callback(partial(self._answer, page, number))

    def _answer(self, page: int, number: Any, done: Future[float]) -> None:
        error = done.exception()
        if error is not None and not isinstance(error, HarnessError):
            error = MachineError(_NO_REASON)
        self._say(["answer", page, number, {"at_s": done.result()} if error is None else {"error": str(error)}])

    def _tell_state(self) -> None:
        """Send the mission second and the state of the controls whenever they change."""
        before: tuple[Any, ...] = ()
        now_s = -1.0
        while not self._ended.wait(STATE_EVERY_S):
            hand, snapshot = self._hand, self._snapshot
            stage = snapshot.stage if snapshot else "starting"
            state = hand.pace is not None, hand.paused, hand.factor, hand.closed, stage
            if state != before:
                before = state
                keys = ("virtual", "paused", "factor", "closed", "stage")
                self._say(["hand", dict(zip(keys, state, strict=True))])
            if snapshot is not None and snapshot.mission_s > now_s:
                now_s = snapshot.mission_s
                self._say(["t", round(now_s, 3)])


class _Overheard:
    """A progress display that also informs the page."""

    def __init__(self, progress: Progress, beside: Beside) -> None:
        self._progress, self._beside = progress, beside

    def show(self, snapshot: Snapshot) -> None:
        self._beside.shows(snapshot)
        self._progress.show(snapshot)

    def close(self) -> None:
        self._progress.close()


def _thread(run: Callable[[], None]) -> threading.Thread:
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def _of(stream: IO[str] | None) -> IO[str]:
    assert stream is not None, "we asked for a pipe"
    return stream


def _do(hand: Interventions, asked: dict[str, Any]) -> Future[float]:
    """Perform a request. Raises ValueError, TypeError, KeyError or AttributeError if the request is invalid."""
    match asked["do"]:
        case "happen":
            return hand.ask(asked["entry"])
        case "pause":
            return hand.pause()
        case "go on":
            return hand.go_on()
        case "step":
            return hand.step(float(asked["seconds"]))
        case "next run":
            return hand.step_to_next_run()
        case "speed":
            return hand.set_factor(None if asked["factor"] is None else float(asked["factor"]))
        case _:
            raise ValueError("the request is unknown")


@contextmanager
def beside(directory: Path, port: int, hand: Interventions) -> Iterator[Beside]:
    """Run a server for a run in that directory. Raises MachineError if it cannot start."""
    server = Beside(directory, port, hand)
    try:
        yield server
    finally:
        server.close()


def require_packages() -> None:
    """Raise MachineError with the install command if a package of the server is missing."""
    try:
        import aiohttp  # noqa: F401
    except ImportError:
        raise MachineError("watching a run needs a further package: `pip install ucp-harness[watch]`") from None
