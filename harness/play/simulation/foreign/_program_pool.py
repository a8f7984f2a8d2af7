"""Keep a pool of programs that run agents in virtual time.

The start of a program takes longer than a short mission, so a pool keeps programs for the next mission. Each process of
the harness has a pool of its own. A forked child starts with an empty pool.
"""

import atexit
import os
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Lock

from harness.play.simulation.foreign.line_program import LineProgram

MAX_IDLE = 128
"""Maximum number of idle programs. If a further program becomes idle, the program that has been idle for the longest
time ends.
"""
GRACE_S = 1.0


class ProgramPool:
    """A pool of idle programs for reuse. `logs` is a directory for the standard error of the programs, with one file
    for each agent. If `logs` is None, standard error is used only in error messages.
    """

    def __init__(self, logs: Path | None = None) -> None:
        self._logs = logs
        self._idle: list[LineProgram] = []
        """Idle programs. The program that has been idle for the longest time is first."""
        self._taken: set[LineProgram] = set()
        self._lock = Lock()

    def take(self, command: Sequence[str], agent_id: int) -> LineProgram:
        """Return an idle program, or a new program. The caller must return the program with `give_back`. Raises OSError
        if a new program cannot be started.
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
        """Return the program to the pool. If the program has not answered its last input, end it."""
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
        """End all programs. Return the names of processes that a program left behind, by agent. Only programs with a
        log are checked.
        """
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
        """Empty the pool without ending the programs. A forked process calls this method, because the programs belong
        to its parent process.
        """
        for program in [*self._taken, *self._idle]:
            program.release()
        self._taken.clear()
        self._idle.clear()
        self._lock = Lock()


SHARED = ProgramPool()
"""The pool of programs for missions in memory. Many missions use this pool, for example the thousands of missions of a
sweep.
"""

atexit.register(SHARED.close)
os.register_at_fork(after_in_child=SHARED.release_all)
