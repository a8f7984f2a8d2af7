"""Check that foreign agents (separate programs) are deterministic.

The check gives each incarnation its inputs again, in another process and at another time, and compares the answers. An
agent that reads a clock, draws random numbers of its own, or keeps data of an earlier incarnation answers differently.
A seed could then not reproduce its runs, so the check reports the agent.
"""

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import zip_longest
from typing import Any

from harness.errors import VIOLATED, HarnessError
from harness.play.simulation.foreign._answer import shown
from harness.play.simulation.foreign._foreign_agent import IncarnationRecord
from harness.play.simulation.foreign.line_program import LineProgram, ProgramFailedError

OF_ITSELF = "it may read a clock, draw random numbers, or depend on the order of a hash table"
OF_BEFORE = "it may keep state of an earlier incarnation in the same process"


class NondeterminismError(HarnessError):
    """An error: an agent gives different answers to the same inputs."""

    exit_status = VIOLATED

    def __init__(self, agent_id: int, detail: str) -> None:
        super().__init__(f"agent {agent_id} {detail} (docs/how-to/simulate-in-virtual-time.md)")
        self.agent_id = agent_id


class DeterminismCheck:
    """A check whether recorded agents are deterministic.

    The object starts one process for each command, so the caller must call `close` after use. If `patient` is true, the
    check first waits for the next second of the clock, because an agent may read a clock in whole seconds.
    """

    def __init__(self, *, patient: bool) -> None:
        self._programs: dict[tuple[str, ...], LineProgram] = {}
        if patient:
            time.sleep(1 - time.time() % 1)

    def compare(self, record: IncarnationRecord) -> None:
        """Give an agent's recorded inputs to a program with the same command. Raises NondeterminismError if an answer
        differs from the recorded one.

        The first incarnation of each command is checked twice, so that each process runs more than one incarnation.
        """
        used = record.command in self._programs
        if not used:
            self._programs[record.command] = LineProgram(record.command)
        for after_another in (used,) if used else (False, True):
            difference = _first_difference(self._programs[record.command], record)
            if difference is not None:
                raise NondeterminismError(record.agent_id, _error_message(record, difference, used=after_another))

    def close(self) -> None:
        for program in self._programs.values():
            program.close()


def _error_message(record: IncarnationRecord, difference: str, *, used: bool) -> str:
    """Return an error message that includes the probable cause.

    The function starts two new processes to find out whether an earlier incarnation in the same process causes the
    difference.
    """
    sentence = f"is not deterministic: {difference}"
    if not used and not record.after_another:
        return f"{sentence}; {OF_ITSELF}"
    differences = []
    for _ in range(2):
        with closing(LineProgram(record.command)) as program:
            differences.append(_first_difference(program, record))
    of_before = differences[0] is None or (record.after_another and differences[0] == differences[1])
    return f"{sentence}; {OF_BEFORE if of_before else OF_ITSELF}"


def _first_difference(program: LineProgram, record: IncarnationRecord) -> str | None:
    """Give the recorded inputs to a program. Return a description of the first answer that differs from the record.
    Return None if all answers are equal.
    """
    for line, answer in record.exchanges:
        try:
            program.write(line)
            again = program.read()
        except ProgramFailedError as error:
            return f"given {_input(line)} again, it {error}"
        if again != answer:
            return f"given {_input(line)} again, it answers {_difference(answer, again)}"
    return None


def _input(line: bytes) -> str:
    given = json.loads(line)
    kinds = {
        "mission": "its mission",
        "datagram": "a datagram",
        "event_id": "an event",
        "timer": "the expiry of its timer",
    }
    what = next((words for key, words in kinds.items() if key in given), f"the command {given.get('command')}")
    return f"{what} at {given['t']:g} s"


def _difference(before: bytes, now: bytes) -> str:
    """Return a description of the first difference between two answers."""
    try:
        different = next(_differences(json.loads(before), json.loads(now), ()), None)
    except (ValueError, RecursionError):
        different = ((), before, now)
    if different is None:
        return "the same in another order or notation; each byte must be equal"
    path, was, is_now = different
    where = f"`{'.'.join(path)}` " if path else ""
    return f"with {where}{shown(is_now)}, and {shown(was)} before"


def _differences(was: Any, is_now: Any, path: Sequence[str]) -> Iterator[tuple[Sequence[str], Any, Any]]:
    if isinstance(was, dict) and isinstance(is_now, dict):
        for key in dict.fromkeys((*was, *is_now)):
            yield from _differences(was.get(key), is_now.get(key), (*path, key))
    elif isinstance(was, list) and isinstance(is_now, list):
        for index, (one, other) in enumerate(zip_longest(was, is_now)):
            yield from _differences(one, other, (*path, str(index)))
    elif was != is_now or type(was) is not type(is_now):
        yield path, was, is_now
