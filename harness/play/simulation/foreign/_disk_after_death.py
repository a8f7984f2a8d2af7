"""Find the content of the disk of a foreign agent (a separate program) that has died.

A program that has ended cannot answer the command `store`. Agents in virtual time are deterministic, so a new program
with the same inputs stores the same data. The input at which the agent died is left out, because an agent writes its
disk at the end of an input.
"""

import json
from contextlib import closing
from typing import Any

from harness.errors import AgentFailedError
from harness.play.simulation.foreign._answer import AnswerError, LacksError, RefusedError, read_answer
from harness.play.simulation.foreign._foreign_agent import IncarnationRecord
from harness.play.simulation.foreign.line_program import LineProgram, ProgramFailedError


def disk_after_death(record: IncarnationRecord, *, tracing: bool) -> tuple[Any] | None:
    """Return the content of the disk. Return None if the agent died before it could store data.

    Raises AgentFailedError if the content cannot be found.
    """
    if not record.exchanges:
        return None
    if record.length >= record.limit:
        raise _error(record, f"only the first {record.limit >> 20} MiB of its inputs were recorded")
    with closing(LineProgram(record.command)) as program:
        try:
            for line, answer in record.exchanges:
                if program.exchange(line) != answer:
                    raise _error(record, "it is not deterministic")
            last_s = json.loads(record.exchanges[-1][0])["t"]
            question = json.dumps({"t": last_s, "command": "store"}).encode("ascii") + b"\n"
            answer = read_answer(program.exchange(question), tracing=tracing).command_answer
        except (ProgramFailedError, AnswerError, LacksError, RefusedError) as error:
            raise _error(record, f"a new program with the same inputs {error}") from None
    if not isinstance(answer, dict) or "store" not in answer:
        raise _error(record, "a new program with the same inputs answered to the command store without `store`")
    return (answer["store"],)


def _error(record: IncarnationRecord, why: str) -> AgentFailedError:
    return AgentFailedError(record.agent_id, "crashed", f"rebooted without its disk, whose content is unknown: {why}")
