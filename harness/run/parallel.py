"""Many tasks on all cores of this machine: an outcome for each, a progress bar, nothing left behind.

    with sweep(tasks, work, jobs, what="runs") as outcomes:
        for task, outcome in outcomes:
            ...

`work` runs in forked processes, so it may be any function and hold anything; a task and its outcome are pickled and
should be small. Why not `concurrent.futures`: there one killed process ends the whole pool. Here each task has its own
outcome, and a task that fails, or whose process is killed, has `Failed`.
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
"""A signal that comes in the moment before we fall asleep is heard when we wake."""

_FORK = multiprocessing.get_context("fork")
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True, slots=True)
class Failed:
    """The outcome of a task that has none: why, in one sentence."""

    reason: str


def cores() -> int:
    """How many processes this machine lets us run at the same time."""
    return len(os.sched_getaffinity(0))


@contextlib.contextmanager
def sweep(
    tasks: Iterable[T], work: Callable[[T], R], jobs: int, *, what: str | None = None, in_order: bool = True
) -> Iterator[Iterator[tuple[T, R | Failed]]]:
    """Each task with its outcome, in the order of `tasks` however many `jobs` there are; 1 forks nothing.

    An outcome is handed over when all before it are, or if not `in_order`, as soon as it is there. A HarnessError that
    `work` raises because the request is wrong, or cannot be met on this machine, is raised here: it would be the same
    for every task. Ctrl-C and SIGTERM raise KeyboardInterrupt; leaving the block, however, ends all processes at once.
    `what` names the tasks on a progress bar on standard error; None shows nothing.
    """
    total = len(tasks) if isinstance(tasks, Sized) else None
    with terminated_is_interrupted(), shown(what, total) as count:
        if jobs == 1:
            yield ((task, raised(count(outcome_of(work, task)))) for task in tasks)
            return
        pool = _Pool(work, jobs, count, in_order)
        try:
            yield pool.outcomes(tasks)
        finally:
            pool.stop()


def outcome_of(work: Callable[[T], R], task: T) -> R | Failed | HarnessError:
    """What comes of one task. A HarnessError is for `raised` to raise where the tasks are handed out."""
    try:
        return work(task)
    except HarnessError as error:
        return Failed(str(error)) if error.exit_status == VIOLATED else error
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        detail = f": {error}" if str(error) else ""
        return Failed(f"{type(error).__name__}{detail} ({Path(place.filename).name} line {place.lineno})")


def raised(outcome: R | HarnessError) -> R:
    if isinstance(outcome, HarnessError):
        raise outcome
    return outcome


class Worker(Generic[T, R]):
    """A process that answers each task with an outcome, until it is killed; it dies with this process."""

    def __init__(self, work: Callable[[T], R]) -> None:
        self.connection, its_end = _FORK.Pipe()
        self._process: BaseProcess = _FORK.Process(target=_serve, args=(work, its_end, os.getpid()), daemon=True)
        self._process.start()
        its_end.close()  # so that its death ends the connection

    def stop(self) -> int:
        """Returns its exit code, as `multiprocessing` has it: minus the signal that ended it."""
        self._process.kill()
        self._process.join()
        exit_code = self._process.exitcode or 0
        self._process.close()
        self.connection.close()
        return exit_code


def _serve(work: Callable[[T], R], connection: Connection, parent: int) -> None:
    CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    os.setpgid(0, 0)  # Ctrl-C reaches the process group that a terminal runs; our parent, which is in it, decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    while os.getppid() == parent:
        connection.send(outcome_of(work, connection.recv()))


class _Pool(Generic[T, R]):
    """One task at a time to each worker: its death then concerns that task only, and another takes its place."""

    def __init__(self, work: Callable[[T], R], jobs: int, count: Callable[[Any], Any], in_order: bool) -> None:
        self._work, self._jobs, self._count, self._in_order = work, jobs, count, in_order
        self._idle: list[Worker[T, R]] = []
        self._busy: dict[Connection, tuple[int, Worker[T, R]]] = {}

    def outcomes(self, tasks: Iterable[T]) -> Iterator[tuple[T, R | Failed]]:
        numbered = enumerate(tasks)
        begun: dict[int, T] = {}
        ended: dict[int, R | Failed] = {}
        due = 0
        while True:
            while len(self._busy) < self._jobs and (following := next(numbered, None)):
                number, begun[number] = following
                self._begin(number, begun[number])
            if not self._busy:
                return
            for connection in wait(list(self._busy), timeout=WAKE_EVERY_S):
                number, outcome = self._end(connection)  # type: ignore[arg-type]  # it waits for other things too
                ended[number] = raised(self._count(outcome))
            while ended and (due in ended or not self._in_order):
                number = due if self._in_order else next(iter(ended))
                yield begun.pop(number), ended.pop(number)
                due += 1

    def stop(self) -> None:
        with signals_held():
            for worker in [*self._idle, *(worker for _, worker in self._busy.values())]:
                worker.stop()
            self._idle.clear()
            self._busy.clear()

    def _begin(self, number: int, task: T) -> None:
        with signals_held():  # no worker is ever unknown to us
            worker = self._idle.pop() if self._idle else Worker(self._work)
            self._busy[worker.connection] = number, worker
        with contextlib.suppress(BrokenPipeError):  # killed while it waited: told when its connection is read
            worker.connection.send(task)

    def _end(self, connection: Connection) -> tuple[int, R | Failed | HarnessError]:
        try:
            outcome = connection.recv()
        except (EOFError, OSError):
            with signals_held():
                number, worker = self._busy.pop(connection)
                return number, Failed(_death(worker.stop()))
        with signals_held():
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
def signals_held() -> Iterator[None]:
    """What must not be interrupted half-way. A process that is forked here begins with the signals held."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def terminated_is_interrupted() -> Iterator[None]:
    """SIGTERM, too, raises KeyboardInterrupt."""
    if threading.current_thread() is not threading.main_thread():  # only there can handlers be set
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def shown(what: str | None, total: int | None) -> Iterator[Callable[[Any], Any]]:
    """A function that counts what passes through it: on a bar, or where there is no terminal, in a line now and then.

    No thread draws, because a process must not be forked beside one.
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
