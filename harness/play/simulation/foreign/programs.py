"""Programs that play agents, and wait for their next mission: to start one takes longer than to play one.

Each process of ours has its own; a process that it forks takes none of them over.
"""

import atexit
import os
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from harness.play.simulation.foreign.program import Program

MAX_IDLE = 64
"""So many wait; more are ended."""
GRACE_S = 1.0


class Programs:
    """`logs` is where their standard error goes, to a file by agent; None keeps it only to say why one failed."""

    def __init__(self, logs: Path | None = None) -> None:
        self._logs = logs
        self._idle: dict[tuple[tuple[str, ...], Path | None], list[Program]] = defaultdict(list)
        self._taken: set[Program] = set()

    def take(self, command: Sequence[str], agent_id: int) -> Program:
        """One that plays nothing, to be given back. Raises OSError if it cannot be started."""
        log = self._logs / f"{agent_id}.log" if self._logs is not None else None
        idle = self._idle[tuple(command), log]
        while idle:
            program = idle.pop()
            if program.runs:
                break
            program.end()
        else:
            program = Program(command, log)
        self._taken.add(program)
        return program

    def give_back(self, program: Program) -> None:
        """Nobody asks it any more, for now."""
        self._taken.discard(program)
        idle = sum(map(len, self._idle.values()))
        if program.owes_an_answer or idle >= MAX_IDLE:
            program.end()
        else:
            program.forget_words()
            self._idle[program.command, program.log].append(program)

    def close(self) -> None:
        """End all of them."""
        programs = [*self._taken, *(program for idle in self._idle.values() for program in idle)]
        self._taken.clear()
        self._idle.clear()
        for program in programs:
            program.close_input()
        deadline = time.monotonic() + GRACE_S
        for program in programs:
            program.end(max(0.0, deadline - time.monotonic()))

    def forget(self) -> None:
        """They are another process's."""
        for program in [*self._taken, *(program for idle in self._idle.values() for program in idle)]:
            program.let_go()
        self._taken.clear()
        self._idle.clear()


SHARED = Programs()
"""Those of missions in memory, of which a sweep plays thousands."""

atexit.register(SHARED.close)
os.register_at_fork(after_in_child=SHARED.forget)
