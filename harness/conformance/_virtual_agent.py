"""Test an agent in virtual time: `COMMAND --virtual` reads inputs and writes answers as lines of text.

A test in virtual time does not wait for timers. It also compares the time at which the next timer expires. One process
runs many incarnations of the agent, one after another.

The module converts a sequence of inputs to these lines, and to the answers that the agent should write.
ucp/contract/CONTRACT.md describes the lines. A line with an input contains its time. A line with an answer contains
datagrams in base64, and the time at which the next timer expires. Each line also has a description in words.
"""

import asyncio
import base64
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from harness.conformance._agent_under_test import AgentUnderTest, Start, mission
from harness.conformance._alphabet import INPUTS, TIMER, AgentInput
from harness.conformance._observation import (
    KnownNames,
    RecordedDatagram,
    TestedStep,
    compare,
    datagram_text,
    message_text,
)
from harness.conformance._reference_model import (
    EVENT_ID,
    Action,
    ControlCommand,
    ExpectedOutcome,
    ExpectedRun,
    LoggedEvent,
    PeerDatagram,
    ReferenceModel,
    TimerExpiry,
)
from harness.conformance._state_space import STEP_S, SettingsVariant, next_timer_name, state_of
from harness.conformance._udp_lab import SILENT, AgentEndedError, AgentExitedError, AgentHangsError, NoAgentError
from harness.conformance.results import FURTHER_CHECKS, CaseResult
from harness.errors import UnsupportedError
from harness.play.simulation.foreign.line_program import ANSWER_LIMIT_S, LineProgram, ProgramFailedError
from ucp.clock import MICROSECONDS


@dataclass(frozen=True)
class VirtualLine:
    """An input for an agent in virtual time, and the expected answer."""

    name: str
    given: dict[str, Any]
    answer: dict[str, Any]
    input_text: str
    """Description of the input."""
    sent_texts: tuple[str, ...]
    """Descriptions of the expected messages."""
    outcome: ExpectedOutcome


class NotPlayableError(Exception):
    """An error: an input is impossible in virtual time, because a timer expired late in the test over UDP."""


class LineWriter:
    """A writer that runs the reference in virtual time, and converts each input and answer to a line."""

    def __init__(self, variant: SettingsVariant) -> None:
        self.model = ReferenceModel(variant.settings)
        self.now = 0.0
        self._variant = variant

    def first_line(self) -> dict[str, Any]:
        """Return the line that starts the agent."""
        return {"t": 0.0, "mission": virtual_mission(self._variant), "trace": False}

    def lines(self, path: Sequence[str]) -> Iterator[VirtualLine]:
        """Yield the lines for these inputs. Raises NotPlayableError."""
        for name in path:
            given = INPUTS[name]
            if given.preceding is not None:
                yield self.line(INPUTS[given.preceding])
                yield self.line(INPUTS[TIMER])
            else:
                yield self.line(given)

    def line(self, given: AgentInput) -> VirtualLine:
        action = given.make(self.model)
        if action is None:
            raise NotPlayableError(given.name)
        deadline = self.model.agent.next_timer()
        self.now = deadline if isinstance(action, TimerExpiry) and deadline is not None else self.now + STEP_S
        timestamp_us = round(self.now * MICROSECONDS)
        outcome = self.model.feed(action, self.now, timestamp_us)
        names = KnownNames(self.model)
        answer = {
            "sent": [base64.b64encode(data).decode("ascii") for data in self.model.datagrams],
            "timer": self.model.agent.next_timer(),
        }
        sent_texts = tuple(message_text(message, names) for message in outcome.sent)
        return VirtualLine(
            given.name,
            given_line(action, self.now, timestamp_us),
            answer,
            _input_text(action, names),
            sent_texts,
            outcome,
        )


def virtual_mission(variant: SettingsVariant) -> dict[str, Any]:
    return mission(variant, address="10.0.0.1", broadcast="10.0.0.255", port=14600, speedup=1.0, keys={"epoch_us": 0})


def given_line(action: Action, now: float, timestamp_us: int) -> dict[str, Any]:
    """Return an input in the format that `COMMAND --virtual` reads."""
    match action:
        case PeerDatagram():
            return {"t": now, "datagram": base64.b64encode(action.data).decode("ascii")}
        case LoggedEvent():
            data = base64.b64encode(action.data).decode("ascii")
            return {"t": now, "event_id": EVENT_ID, "data": data, "timestamp_us": timestamp_us}
        case ControlCommand():
            return {"t": now, "command": action.name}
    return {"t": now, "timer": True}


def _input_text(action: Action, names: KnownNames) -> str:
    match action:
        case PeerDatagram():
            return f"{datagram_text(action.data, names)} of agent {action.sender}"
        case LoggedEvent():
            return "an event that fills a block"
        case ControlCommand():
            return f"the command {action.name}"
    return "the next timer ends"


END_CASE = "the program ends with status 0 at the end of its input"
END_SECTION = "contract, Virtual time"
RIGHT_END = "status 0"


class VirtualProgram:
    """A process of `COMMAND --virtual`. Waiting for its answers does not block the event loop. Raises NoAgentError."""

    def __init__(self, command: Sequence[str], errors: Path) -> None:
        try:
            self._program = LineProgram(command, errors)
        except OSError as error:
            raise NoAgentError(f"the agent cannot be started: {error.strerror}") from None
        self._lines = 0
        self.broken = False

    async def ask(self, line: dict[str, Any]) -> dict[str, Any]:
        """Send a line to the agent, and return its answer. Raises AgentEndedError, UnsupportedError."""
        self._lines += 1
        text = json.dumps(line).encode("ascii") + b"\n"
        exchange = asyncio.ensure_future(asyncio.to_thread(self._program.exchange, text))
        try:
            answer = json.loads(await asyncio.shield(exchange))
        except asyncio.CancelledError:
            self._program.kill()  # the thread still reads from the program
            await asyncio.wait([exchange])
            exchange.exception()  # otherwise asyncio reports the end of the program as an unread exception
            self.broken = True
            raise
        except ProgramFailedError as error:
            self.broken = True
            raise self._end_error(error) from None
        except (ValueError, RecursionError) as error:
            self.broken = True
            raise AgentEndedError(f"no readable answer: {error}") from None
        if not isinstance(answer, dict):
            self.broken = True
            raise AgentEndedError("its answer is not a JSON object")
        if "error" in answer:
            if answer.get("unsupported") is True:
                raise UnsupportedError(str(answer["error"]))
            raise AgentEndedError(f"it answers with an error: {answer['error']}")
        return answer

    def _end_error(self, error: ProgramFailedError) -> AgentEndedError:
        if error.outcome == "hung":
            return AgentHangsError(f"it hangs: it {error} to line {self._lines} of its process")
        if self._program.runs:
            return AgentEndedError(f"it {error}")
        return AgentExitedError(f"it {error}: {self._program.last_line() or SILENT}")

    async def finish(self) -> str:
        """Close the input of the process, and return a phrase about the end of the process. If the agent follows the
        contract, the phrase is "status 0".
        """
        status = await asyncio.to_thread(self._program.finish, ANSWER_LIMIT_S)
        return f"it still runs after {ANSWER_LIMIT_S:g} s" if status is None else f"status {status}"

    def close(self) -> None:
        """End the process and all processes that it started. This works even if they keep its pipes open."""
        self._program.close()


class VirtualTimeAgent(AgentUnderTest):
    """An agent in virtual time, from its start to its end. When it ends, its process can be added to the list `idle`
    for reuse.
    """

    def __init__(self, variant: SettingsVariant, program: VirtualProgram, idle: list[VirtualProgram] | None) -> None:
        super().__init__(variant)
        self._program = program
        self._idle = idle
        self._now = 0.0
        self._record: list[RecordedDatagram] = []
        self._stopped_timers: dict[float, ExpectedRun] = {}
        """The time at which a stopped timer would have expired -> the handler run that stopped the timer."""

    @classmethod
    async def start(
        cls, variant: SettingsVariant, program: VirtualProgram, idle: list[VirtualProgram] | None
    ) -> "VirtualTimeAgent":
        agent = cls(variant, program, idle)
        try:
            await program.ask({"t": 0.0, "mission": virtual_mission(variant), "trace": False})
        except BaseException:
            await agent.close()
            raise
        return agent

    @property
    def timer_is_near(self) -> bool:
        deadline = self.model.agent.next_timer()
        return deadline is not None and deadline - self._now <= STEP_S

    def exchanges(self) -> tuple[RecordedDatagram, ...]:
        return tuple(self._record)

    async def close(self) -> None:
        if self._program.broken or self._idle is None:
            self._program.close()
        else:
            self._idle.append(self._program)

    async def _step(self, given: AgentInput) -> TestedStep | None:
        model = self.model
        before, deadline = state_of(model), model.agent.next_timer()
        action = given.make(model)
        if action is None:
            return None
        self._now = deadline if isinstance(action, TimerExpiry) and deadline is not None else self._now + STEP_S
        timestamp_us = round(self._now * MICROSECONDS)
        running = _deadlines(model)
        outcome = model.feed(action, self._now, timestamp_us)
        if not isinstance(action, TimerExpiry):
            self._stopped_timers |= dict.fromkeys(running - _deadlines(model), outcome.runs[0]) if outcome.runs else {}
        line = given_line(action, self._now, timestamp_us)
        wrong, sent, status = list[str](), list[bytes](), dict[str, Any]()
        ended = None
        announced_s, expected_s = model.agent.next_timer(), model.agent.next_timer()
        names = KnownNames(model)
        try:
            answer = await self._program.ask(line)
            sent = [base64.b64decode(text, validate=True) for text in answer["sent"]]
            announced_s = answer.get("timer")
            reported = (await self._program.ask({"t": self._now, "command": "status"})).get("answer")
            status = reported if isinstance(reported, dict) else {}
        except (AgentEndedError, UnsupportedError) as error:
            wrong.append(str(error))
            ended = str(error) if isinstance(error, AgentHangsError | AgentExitedError) else None
        except (KeyError, TypeError, ValueError):
            wrong.append("its answer has no `sent`, a list of datagrams in base64")
        if "datagram" in line:
            data = base64.b64decode(line["datagram"])
            self._record.append(RecordedDatagram(self._now, False, data, datagram_text(data, names)))
        self._record += [RecordedDatagram(self._now, True, data, datagram_text(data, names)) for data in sent]
        timer = next_timer_name(model)
        observation = replace(compare(model, given, before, outcome, sent, status, wrong), ended=ended)
        if _same_instant(announced_s, expected_s):
            return replace(observation, running_timer=timer)
        sentence = f"according to its answer its next timer expires at {announced_s} s, not at {expected_s} s"
        differing = replace(observation, wrong=(*observation.wrong, sentence))
        if observation.wrong:  # a wrong handler run starts other timers, so this difference is no further evidence
            return differing
        if isinstance(announced_s, float) and announced_s in self._stopped_timers:
            return replace(differing, hidden_run=self._stopped_timers[announced_s])
        started = (each.name for each in model.state.timers if each.deadline and each.deadline not in running)
        return replace(differing, wrong_timer=next(started, None))


def _deadlines(model: ReferenceModel) -> set[float]:
    return {timer.deadline for timer in model.state.timers if timer.deadline is not None}


def _same_instant(announced_s: Any, expected_s: float | None) -> bool:
    if expected_s is None or announced_s is None:
        return expected_s is announced_s
    return isinstance(announced_s, int | float) and math.isclose(announced_s, expected_s, rel_tol=1e-9)


async def case_of_end(programs: Sequence[VirtualProgram]) -> CaseResult:
    """Close the input of these processes. Return the result of the test case about their exit status."""
    ends = [await program.finish() for program in programs]
    wrong = next((end for end in ends if end != RIGHT_END), None)
    if wrong is None:
        return CaseResult(END_CASE, FURTHER_CHECKS, "passed" if ends else "not tried", section=END_SECTION)
    reason = f"expected {RIGHT_END} at the end of the input; came {wrong}"
    return CaseResult(END_CASE, FURTHER_CHECKS, "failed", reason=reason, wrong=(reason,), section=END_SECTION)


def starter(command: Sequence[str], errors: Path) -> tuple[Start, list[VirtualProgram]]:
    """Return a function that starts agents in virtual time, and a list of idle processes. The caller must close these
    processes at the end.
    """
    idle: list[VirtualProgram] = []

    async def start(variant: SettingsVariant, alone: bool) -> AgentUnderTest:
        if alone:  # an earlier incarnation of the process may be the cause of a failure
            return await VirtualTimeAgent.start(variant, VirtualProgram(command, errors), None)
        program = idle.pop() if idle else VirtualProgram(command, errors)
        return await VirtualTimeAgent.start(variant, program, idle)

    return start, idle
