"""Whether agents are the same twice: each life is given its inputs once more, in another process and at another time.

An agent that reads a clock, draws random numbers of its own, or keeps something from an earlier life answers otherwise.
Then no seed would mean anything, so it is found out, and named.
"""

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import zip_longest
from typing import Any

from harness.errors import VIOLATED, HarnessError
from harness.play.simulation.foreign._answer import shown
from harness.play.simulation.foreign._foreign_agent import LifeRecord
from harness.play.simulation.foreign._virtual_program import Program, ProgramFailedError

OF_ITSELF = "it may read a clock, draw random numbers, or depend on the order of a hash table"
OF_BEFORE = "it may keep state of an earlier incarnation in the same process"


class NotTheSameError(HarnessError):
    """An agent answers the same inputs otherwise when it is given them again."""

    exit_status = VIOLATED

    def __init__(self, agent_id: int, detail: str) -> None:
        super().__init__(f"agent {agent_id} {detail} (docs/how-to/simulate-in-virtual-time.md)")
        self.agent_id = agent_id


class Again:
    """Gives lives their inputs again, one after another in one process of each make. Close it.

    If `patient`, not within the second in which they were played: clocks may be looked at in whole seconds.
    """

    def __init__(self, *, patient: bool) -> None:
        self._programs: dict[tuple[str, ...], Program] = {}
        if patient:
            time.sleep(1 - time.time() % 1)

    def compare(self, record: LifeRecord) -> None:
        """The first life of each make is given its inputs twice, so that a process plays more than one.

        Raises NotTheSameError.
        """
        used = record.command in self._programs
        if not used:
            self._programs[record.command] = Program(record.command)
        for after_another in (used,) if used else (False, True):
            difference = _given_to(self._programs[record.command], record)
            if difference is not None:
                raise NotTheSameError(record.agent_id, _explained(record, difference, used=after_another))

    def close(self) -> None:
        for program in self._programs.values():
            program.close()


def _explained(record: LifeRecord, difference: str, *, used: bool) -> str:
    """Whether what came before in a process makes the difference: two that are new say so."""
    sentence = f"is not deterministic: {difference}"
    if not used and not record.after_another:
        return f"{sentence}; {OF_ITSELF}"
    differences = []
    for _ in range(2):
        with closing(Program(record.command)) as program:
            differences.append(_given_to(program, record))
    of_before = differences[0] is None or (record.after_another and differences[0] == differences[1])
    return f"{sentence}; {OF_BEFORE if of_before else OF_ITSELF}"


def _given_to(program: Program, record: LifeRecord) -> str | None:
    """What it answers otherwise than is on record, first; None if nothing."""
    for line, answer in record.exchanges:
        try:
            program.tell(line)
            again = program.answer()
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
    """Where two answers differ first."""
    try:
        parted = next(_parted(json.loads(before), json.loads(now), ()), None)
    except (ValueError, RecursionError):
        parted = ((), before, now)
    if parted is None:
        return "the same in another order or notation; each byte must be equal"
    path, was, is_now = parted
    where = f"`{'.'.join(path)}` " if path else ""
    return f"with {where}{shown(is_now)}, and {shown(was)} before"


def _parted(was: Any, is_now: Any, path: Sequence[str]) -> Iterator[tuple[Sequence[str], Any, Any]]:
    if isinstance(was, dict) and isinstance(is_now, dict):
        for key in dict.fromkeys((*was, *is_now)):
            yield from _parted(was.get(key), is_now.get(key), (*path, key))
    elif isinstance(was, list) and isinstance(is_now, list):
        for index, (one, other) in enumerate(zip_longest(was, is_now)):
            yield from _parted(one, other, (*path, str(index)))
    elif was != is_now or type(was) is not type(is_now):
        yield path, was, is_now
