"""The page of a run that goes on: its server is a process beside the run, started before it and ended after it.

Between the two go lines of JSON. Down go `["t", mission second]`, `["hand", state]` and answers to what was asked for;
up comes first the page's address, and then `[page, number, what somebody there asks for]`.
"""

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from harness.errors import HarnessError, MachineError
from harness.play.interventions import Interventions
from harness.play.progress import Progress, Snapshot

STATE_EVERY_S = 0.1
_NO_REASON = "it does not say why"


class Beside:
    """The server's process, and what pages ask of the run through it. `address` is that of the page."""

    def __init__(self, directory: Path, port: int, hand: Interventions) -> None:
        """Raises MachineError if there can be none: a package is missing, or the port cannot be had."""
        require_packages()
        self._hand = hand
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "harness.watch", str(directory), str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C ends the run first
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._to, self._from = self._process.stdin, self._process.stdout
        self.address = self._from.readline().strip()
        if not self.address:
            last_words = self._process.stderr.read().strip().splitlines() or [_NO_REASON]
            raise MachineError(last_words[-1])
        self._writing = threading.Lock()
        self._ended = threading.Event()
        self._readers: int | None = None
        self._snapshot: Snapshot | None = None
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._hear, self._tell_state)]
        for thread in self._threads:
            thread.start()

    def overhears(self, progress: Progress) -> Progress:
        """`progress`, of which the page hears."""
        return _Overheard(progress, self)

    def shows(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot

    def run_is_over(self) -> bool:
        """Tell the page; whether anybody looks at it."""
        self._ended.set()
        self._threads[1].join()
        self._say(["over"])
        self._threads[0].join()
        return bool(self._readers)

    def wait(self) -> None:
        """Until nobody looks any more, or Ctrl-C."""
        with suppress(KeyboardInterrupt):
            self._process.wait()

    def close(self) -> None:
        self._ended.set()
        self._process.terminate()
        self._process.wait()
        for thread in self._threads:
            thread.join()
        for stream in (self._to, self._from, self._process.stderr):
            with suppress(OSError):
                assert stream is not None
                stream.close()

    def _say(self, what: list[Any]) -> None:
        """A server that has failed is no affair of the run's."""
        with self._writing, suppress(OSError, ValueError):
            self._to.write(json.dumps(what) + "\n")
            self._to.flush()

    def _hear(self) -> None:
        for line in self._from:
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
        """Tell the page how late it is, and what can be asked for, whenever that has changed."""
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
    """A run's progress, which the page is told, too."""

    def __init__(self, progress: Progress, beside: Beside) -> None:
        self._progress, self._beside = progress, beside

    def show(self, snapshot: Snapshot) -> None:
        self._beside.shows(snapshot)
        self._progress.show(snapshot)

    def close(self) -> None:
        self._progress.close()


def _do(hand: Interventions, asked: dict[str, Any]) -> Future[float]:
    """Raises ValueError, TypeError, KeyError or AttributeError if nothing of the kind can be asked for."""
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
            raise ValueError("nobody knows what that is")


@contextmanager
def beside(directory: Path, port: int, hand: Interventions) -> Iterator[Beside]:
    """A server for the run that is about to begin in that directory. Raises MachineError if there can be none."""
    server = Beside(directory, port, hand)
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
