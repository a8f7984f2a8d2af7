"""Run many tasks on all processor cores of this machine, with a progress bar. No worker process remains afterwards.

    with sweep(tasks, work, jobs, what="runs") as outcomes:
        for task, outcome in outcomes:
            ...

`work` runs in forked processes, so it may be any function with any data. Tasks and outcomes are pickled and should be
small. A task that raises an exception, or whose process is killed, has the outcome `FailedTask`. All other tasks go on.
`concurrent.futures` was rejected, because there a killed process ends the whole pool.
"""

import contextlib
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sized
from ctypes import CDLL
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Generic, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from harness.errors import VIOLATED, HarnessError

T = TypeVar("T")
R = TypeVar("R")

REDRAW_EVERY_S = 0.1
LINE_EVERY_S = 10.0
WAKE_EVERY_S = 1.0
"""Maximum number of seconds that the parent process waits without checking for signals. A signal that arrives just
before the wait would otherwise be handled only after the wait.
"""

_FORK = multiprocessing.get_context("fork")
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True, slots=True)
class FailedTask:
    """The result of a task that failed. `reason` is one sentence."""

    reason: str


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0))


@contextlib.contextmanager
def sweep(
    tasks: Iterable[T], work: Callable[[T], R], jobs: int, *, what: str | None = None, in_order: bool = True
) -> Iterator[Iterator[tuple[T, R | FailedTask]]]:
    """Execute the tasks in `jobs` processes, and yield each task with its result. If `in_order` is true, the results
    have the order of `tasks`. Otherwise each result is yielded as soon as it is known.

    - `jobs`: number of processes. With 1, the tasks run in this process.
    - `what`: name of the tasks for a progress bar on standard error. None shows no bar.

    A HarnessError of `work` that means a wrong request or an unsuitable machine is raised here, because it would occur
    in every task. Ctrl-C and SIGTERM raise KeyboardInterrupt. The end of the context ends all processes immediately.
    """
    total = len(tasks) if isinstance(tasks, Sized) else None
    with sigterm_as_ctrl_c(), progress_bar(what, total) as count:
        if jobs == 1:
            yield ((task, raise_error(count(outcome_of(work, task)))) for task in tasks)
            return
        pool = _WorkerPool(work, jobs, count, in_order)
        try:
            yield pool.outcomes(tasks)
        finally:
            pool.stop()


def outcome_of(work: Callable[[T], R], task: T) -> R | FailedTask | HarnessError:
    """Call `work` with one task in a worker process, and return the result or the error. The parent process passes the
    returned value to `raise_error`.
    """
    try:
        return work(task)
    except HarnessError as error:
        return FailedTask(str(error)) if error.exit_status == VIOLATED else error
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        detail = f": {error}" if str(error) else ""
        return FailedTask(f"{type(error).__name__}{detail} ({Path(place.filename).name} line {place.lineno})")


def raise_error(outcome: R | HarnessError) -> R:
    """Return the outcome of a task. If it is an error that concerns every task, raise it instead."""
    if isinstance(outcome, HarnessError):
        raise outcome
    return outcome


class WorkerProcess(Generic[T, R]):
    """A process that executes tasks until it is killed. The process also ends with its parent process."""

    def __init__(self, work: Callable[[T], R]) -> None:
        self.connection, its_end = _FORK.Pipe()
        self._process: BaseProcess = _FORK.Process(target=_serve, args=(work, its_end, os.getpid()), daemon=True)
        self._process.start()
        its_end.close()  # otherwise the end of the process would not end the connection

    def stop(self) -> int:
        """Kill the process. Return its exit code, or the negative number of the signal that ended it."""
        self._process.kill()
        self._process.join()
        exit_code = self._process.exitcode or 0
        self._process.close()
        self.connection.close()
        return exit_code


def _serve(work: Callable[[T], R], connection: Connection, parent: int) -> None:
    CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    os.setpgid(0, 0)  # Ctrl-C on the terminal must reach only the parent
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    while os.getppid() == parent:
        connection.send(outcome_of(work, connection.recv()))


class _WorkerPool(Generic[T, R]):
    """A pool of workers that execute one task each. If a worker dies, only its task fails, and a new worker replaces
    it.
    """

    def __init__(self, work: Callable[[T], R], jobs: int, count: Callable[[Any], Any], in_order: bool) -> None:
        self._work, self._jobs, self._count, self._in_order = work, jobs, count, in_order
        self._idle: list[WorkerProcess[T, R]] = []
        self._busy: dict[Connection, tuple[int, WorkerProcess[T, R]]] = {}

    def outcomes(self, tasks: Iterable[T]) -> Iterator[tuple[T, R | FailedTask]]:
        numbered = enumerate(tasks)
        begun: dict[int, T] = {}
        ended: dict[int, R | FailedTask] = {}
        due = 0
        while True:
            while len(self._busy) < self._jobs and (following := next(numbered, None)):
                number, begun[number] = following
                self._begin(number, begun[number])
            if not self._busy:
                return
            for connection in wait(list(self._busy), timeout=WAKE_EVERY_S):
                number, outcome = self._end(connection)  # type: ignore[arg-type]  # `wait` also accepts other objects
                ended[number] = raise_error(self._count(outcome))
            while ended and (due in ended or not self._in_order):
                number = due if self._in_order else next(iter(ended))
                yield begun.pop(number), ended.pop(number)
                due += 1

    def stop(self) -> None:
        with signals_blocked():
            for worker in [*self._idle, *(worker for _, worker in self._busy.values())]:
                worker.stop()
            self._idle.clear()
            self._busy.clear()

    def _begin(self, number: int, task: T) -> None:
        with signals_blocked():  # an interruption here would leave a worker that `stop` does not know
            worker = self._idle.pop() if self._idle else WorkerProcess(self._work)
            self._busy[worker.connection] = number, worker
        with contextlib.suppress(BrokenPipeError):  # a killed worker is noticed when its connection is read
            worker.connection.send(task)

    def _end(self, connection: Connection) -> tuple[int, R | FailedTask | HarnessError]:
        try:
            outcome = connection.recv()
        except (EOFError, OSError):
            with signals_blocked():
                number, worker = self._busy.pop(connection)
                return number, FailedTask(_death(worker.stop()))
        with signals_blocked():
            number, worker = self._busy.pop(connection)
            self._idle.append(worker)
        return number, outcome


def _death(exit_code: int) -> str:
    if exit_code >= 0:
        return f"its worker process ended with status {exit_code}"
    name = signal.Signals(-exit_code).name
    hint = ", as the kernel does when memory runs out" if name == "SIGKILL" else ""
    return f"its worker process was killed by {name}{hint}"


@contextlib.contextmanager
def signals_blocked() -> Iterator[None]:
    """Block SIGINT and SIGTERM inside the context. If a process is forked inside the context, the signals are also
    blocked in the new process.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def sigterm_as_ctrl_c() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt inside the context."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread can set handlers
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def progress_bar(what: str | None, total: int | None) -> Iterator[Callable[[Any], Any]]:
    """Show a progress bar. Yield a function that counts the results passed to it.

    On a terminal, the function draws a bar. Elsewhere it prints a line every few seconds. The function uses no thread,
    because forking a process with threads is unsafe.
    """
    if what is None:
        yield lambda outcome: outcome
        return
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=console, auto_refresh=False, transient=True, disable=not console.is_terminal)
    line = bar.add_task(what, total=total)
    every_s, last, done = REDRAW_EVERY_S if console.is_terminal else LINE_EVERY_S, time.monotonic(), 0

    def count(outcome: Any) -> Any:
        nonlocal last, done
        done += 1
        if time.monotonic() - last >= every_s:
            last = time.monotonic()
            bar.update(line, completed=done, refresh=True)
            if not console.is_terminal:
                of = f" of {total}" if total is not None else ""
                console.print(f"{done}{of} {what}", highlight=False, soft_wrap=True)
        return outcome

    with bar:
        yield count
