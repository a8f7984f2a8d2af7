"""An agent in virtual time beside the reference: `COMMAND --virtual`, which reads inputs and writes answers as lines.

Nobody waits for a timer, and the instant at which the next one ends is compared as well. One process lives many lives.
"""

import asyncio
import base64
import json
import math
import os
import signal
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness.conformance._alphabet import Input
from harness.conformance._observation import Exchange, Names, Seen, compare, told_datagram
from harness.conformance._reference_model import Expire, Model, Run
from harness.conformance._state_space import STEP_S, Variant, ends_next, state_of
from harness.conformance._subject import Start, Subject
from harness.conformance._udp_lab import (
    ANSWER_LIMIT_S,
    GRACE_S,
    LOOK_AGAIN_S,
    START_LIMIT_S,
    AgentEndedError,
    AgentExitedError,
    AgentHangsError,
    NoAgentError,
    last_line,
)
from harness.conformance._virtual_lines import given_line, virtual_mission
from harness.errors import UnsupportedError
from harness.play.child_processes import ChildProcesses
from ucp.clock import MICROSECONDS

ANSWER_BYTES = 4 * 1024 * 1024
NO_AGENT = "the agent does not answer in virtual time"


class Program:
    """A process of the agent."""

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        processes: ChildProcesses,
        given: asyncio.StreamWriter,
        reading: asyncio.ReadTransport,
        answers: asyncio.StreamReader,
        errors: Path,
    ) -> None:
        self._process = process
        self._processes = processes
        self._given = given
        self._reading = reading
        self._answers = answers
        self._errors = errors
        self._lines = 0
        self.broken = False

    @classmethod
    async def start(cls, command: Sequence[str], errors: Path) -> "Program":
        """Not by asyncio's own subprocess_exec: where that is cancelled, it waits for ever for pipes nobody closes."""
        try:
            processes = ChildProcesses()
            with errors.open("ab") as file:
                process = subprocess.Popen(
                    [*command, "--virtual"],
                    bufsize=0,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=file,
                    start_new_session=True,
                    env=processes.environment(os.environ),
                )
        except OSError as error:
            raise NoAgentError(f"the agent cannot be started: {error.strerror}") from None
        try:
            return await cls._connected(process, processes, errors)
        except BaseException:
            await _end(process, processes)
            raise

    @classmethod
    async def _connected(cls, process: subprocess.Popen[bytes], processes: ChildProcesses, errors: Path) -> "Program":
        loop = asyncio.get_running_loop()
        answers = asyncio.StreamReader(ANSWER_BYTES)
        protocol = asyncio.StreamReaderProtocol(asyncio.StreamReader())  # which tells a writer when there is room
        reading, _ = await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(answers), process.stdout)
        try:
            writing, _ = await loop.connect_write_pipe(lambda: protocol, process.stdin)
        except BaseException:
            reading.close()
            raise
        return cls(process, processes, asyncio.StreamWriter(writing, protocol, None, loop), reading, answers, errors)

    async def ask(self, line: dict[str, Any], limit_s: float = ANSWER_LIMIT_S) -> dict[str, Any]:
        """Its answer. Raises AgentEndedError, UnsupportedError."""
        self._lines += 1
        try:
            async with asyncio.timeout(limit_s):
                self._given.write(json.dumps(line).encode("ascii") + b"\n")
                await self._given.drain()
                text = await self._answers.readline()
                answer = json.loads(text) if text else None
        except TimeoutError:
            self.broken = True
            line_number = f"line {self._lines} of its process"
            raise AgentHangsError(f"it hangs: it did not answer {line_number} within {limit_s:g} s") from None
        except (OSError, ValueError, RecursionError) as error:
            self.broken = True
            raise AgentEndedError(f"no readable answer: {error}") from None
        if answer is None:
            self.broken = True
            with suppress(TimeoutError):
                await asyncio.wait_for(_ended(self._process), GRACE_S)
            if self._process.returncode is None:
                raise AgentEndedError("it closed its standard output and still runs")
            raise AgentExitedError(f"it ended with status {self._process.returncode}: {last_line(self._errors)}")
        if not isinstance(answer, dict):
            self.broken = True
            raise AgentEndedError("its answer is not a JSON object")
        if "error" in answer:
            if answer.get("unsupported") is True:
                raise UnsupportedError(str(answer["error"]))
            raise AgentEndedError(f"it answers with an error: {answer['error']}")
        return answer

    async def close(self) -> None:
        """With all that it has started, whoever else holds its pipes."""
        if not self._given.is_closing():
            self._given.transport.abort()
        self._reading.close()
        await _end(self._process, self._processes)


async def _end(process: subprocess.Popen[bytes], processes: ChildProcesses) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    for pipe in filter(None, (process.stdin, process.stdout)):
        pipe.close()
    await _ended(process)
    processes.end()


async def _ended(process: subprocess.Popen[bytes]) -> None:
    while process.poll() is None:
        await asyncio.sleep(LOOK_AGAIN_S)


class InVirtualTime(Subject):
    """One incarnation in a process, which the next one uses if `idle` is a list."""

    def __init__(self, variant: Variant, program: Program, idle: list[Program] | None) -> None:
        super().__init__(variant)
        self._program = program
        self._idle = idle
        self._now = 0.0
        self._record: list[Exchange] = []
        self._stopped: dict[float, Run] = {}
        """When timers would have ended, and what stopped them."""

    @classmethod
    async def start(cls, variant: Variant, program: Program, idle: list[Program] | None) -> "InVirtualTime":
        subject = cls(variant, program, idle)
        try:
            await program.ask({"t": 0.0, "mission": virtual_mission(variant), "trace": False}, START_LIMIT_S)
        except BaseException:
            await subject.close()
            raise
        return subject

    @property
    def hurried(self) -> bool:
        deadline = self.model.agent.next_timer()
        return deadline is not None and deadline - self._now <= STEP_S

    def exchanges(self) -> tuple[Exchange, ...]:
        return tuple(self._record)

    async def close(self) -> None:
        if self._program.broken or self._idle is None:
            await self._program.close()
        else:
            self._idle.append(self._program)

    async def _step(self, given: Input) -> Seen | None:
        model = self.model
        before, deadline = state_of(model), model.agent.next_timer()
        action = given.make(model)
        if action is None:
            return None
        self._now = deadline if isinstance(action, Expire) and deadline is not None else self._now + STEP_S
        timestamp_us = round(self._now * MICROSECONDS)
        running = _deadlines(model)
        outcome = model.feed(action, self._now, timestamp_us)
        if not isinstance(action, Expire):
            self._stopped |= dict.fromkeys(running - _deadlines(model), outcome.runs[0]) if outcome.runs else {}
        line = given_line(action, self._now, timestamp_us)
        wrong, sent, status = list[str](), list[bytes](), dict[str, Any]()
        ended = None
        ends, should = model.agent.next_timer(), model.agent.next_timer()
        names = Names(model)
        try:
            answer = await self._program.ask(line)
            sent = [base64.b64decode(text, validate=True) for text in answer["sent"]]
            ends = answer.get("timer")
            told = (await self._program.ask({"t": self._now, "command": "status"})).get("answer")
            status = told if isinstance(told, dict) else {}
        except (AgentEndedError, UnsupportedError) as error:
            wrong.append(str(error))
            ended = str(error) if isinstance(error, AgentHangsError | AgentExitedError) else None
        except (KeyError, TypeError, ValueError):
            wrong.append("its answer has no `sent`, a list of datagrams in base64")
        if "datagram" in line:
            data = base64.b64decode(line["datagram"])
            self._record.append(Exchange(self._now, False, data, told_datagram(data, names)))
        self._record += [Exchange(self._now, True, data, told_datagram(data, names)) for data in sent]
        timer = ends_next(model)
        seen = replace(compare(model, given, before, outcome, sent, status, wrong), ended=ended)
        if _same_instant(ends, should):
            return replace(seen, started=timer)
        sentence = f"according to its answer its next timer expires at {ends} s, not at {should} s"
        told = replace(seen, wrong=(*seen.wrong, sentence))
        if seen.wrong:  # what does something else starts other timers
            return told
        if isinstance(ends, float) and ends in self._stopped:
            return replace(told, hidden=self._stopped[ends])
        begun = (each.name for each in model.state.timers if each.deadline and each.deadline not in running)
        return replace(told, mistimed=next(begun, None))


def _deadlines(model: Model) -> set[float]:
    return {timer.deadline for timer in model.state.timers if timer.deadline is not None}


def _same_instant(ends: Any, should: float | None) -> bool:
    if should is None or ends is None:
        return should is ends
    return isinstance(ends, int | float) and math.isclose(ends, should, rel_tol=1e-9)


def starting(command: Sequence[str], errors: Path) -> tuple[Start, list[Program]]:
    """Agents in virtual time; and the processes of which they are made, to be closed at the end."""
    idle: list[Program] = []

    async def start(variant: Variant, alone: bool) -> Subject:
        if alone:  # an earlier incarnation of the process may be the cause of a failure
            return await InVirtualTime.start(variant, await Program.start(command, errors), None)
        program = idle.pop() if idle else await Program.start(command, errors)
        return await InVirtualTime.start(variant, program, idle)

    return start, idle
