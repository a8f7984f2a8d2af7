"""Programs that play agents, and wait for their next mission: to start one takes longer than to play one.

Each process of ours has its own; a process that it forks takes none of them over.
"""

import atexit
import os
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Lock

from harness.play.simulation.foreign.virtual_program import Program

MAX_IDLE = 128
"""So many wait; who has waited longest is ended."""
GRACE_S = 1.0


class Programs:
    """`logs` is where their standard error goes, to a file by agent; None keeps it only to say why one failed."""

    def __init__(self, logs: Path | None = None) -> None:
        self._logs = logs
        self._idle: list[Program] = []
        """Who came last has waited least."""
        self._taken: set[Program] = set()
        self._lock = Lock()

    def take(self, command: Sequence[str], agent_id: int) -> Program:
        """One that plays nothing, to be given back. Raises OSError if it cannot be started."""
        log = self._logs / f"{agent_id}.log" if self._logs is not None else None
        with self._lock:
            program = self._waiting(tuple(command), log) or Program(command, log)
            self._taken.add(program)
        return program

    def _waiting(self, command: tuple[str, ...], log: Path | None) -> Program | None:
        for program in reversed(self._idle):
            if (program.command, program.log) == (command, log):
                self._idle.remove(program)
                if program.runs:
                    return program
                program.close()
                return self._waiting(command, log)
        return None

    def give_back(self, program: Program) -> None:
        """Nobody asks it any more, for now."""
        with self._lock:
            self._taken.discard(program)
            if program.owes_an_answer:
                program.close()
                return
            program.forget_words()
            self._idle.append(program)
            if len(self._idle) > MAX_IDLE:
                self._idle.pop(0).close()

    def close(self) -> None:
        """End all of them."""
        programs = [*self._taken, *self._idle]
        self._taken.clear()
        self._idle.clear()
        for program in programs:
            program.close_input()
        deadline = time.monotonic() + GRACE_S
        for program in programs:
            program.end(max(0.0, deadline - time.monotonic()))

    def forget(self) -> None:
        """They are another process's."""
        for program in [*self._taken, *self._idle]:
            program.let_go()
        self._taken.clear()
        self._idle.clear()
        self._lock = Lock()


SHARED = Programs()
"""Those of missions in memory, of which a sweep plays thousands."""

atexit.register(SHARED.close)
os.register_at_fork(after_in_child=SHARED.forget)
