"""Run a foreign agent (a separate program) in virtual time, from a start to the next end. This object has the same
interface as an agent in this process.

The harness writes each input to the program as a line. The answer contains the datagrams that the agent sends, the
expiry of its next timer, and the lines of its trace. The harness asks for the agent's state with the commands of the
control socket. These commands are not part of the mission, so the harness discards their trace lines.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from harness.archive.exports import Export
from harness.errors import AgentFailedError
from harness.play.agent_control import AgentStatus, is_shell_error, last_line
from harness.play.simulation._simulated_agent import AgentOutput, DiskContents
from harness.play.simulation.foreign._answer import (
    AgentLacksError,
    AnswerError,
    ForeignAnswer,
    LacksError,
    Outcome,
    RefusedError,
    read_answer,
)
from harness.play.simulation.foreign.line_program import LineProgram, ProgramFailedError
from harness.scenario.scenario import AgentClock
from ucp.events import LoggableEvent
from ucp.messages import Datagram, Message
from ucp.settings import Settings
from ucp.trace import Entry, HandlerRun, RecordedBytes, in_base64

MAX_TIMERS_PER_S = 10_000
"""Maximum number of timer expiries in a mission second. An agent with more expiries counts as hung."""
MAX_SENT_PER_S = 5000
"""Maximum number of datagrams that an agent may send in a mission second. Without a limit, the datagrams and their
answers could grow without end.
"""
ROUNDED_S = 2e-6
"""Tolerance in seconds for times in a trace, which are rounded to six decimals."""
NO_VIRTUAL_TIME = (2, 127)
"""Exit statuses of programs that do not support virtual time. Such a program ends with 2 if it interprets `--virtual`
as the name of a mission file, and with 127 if it refuses the argument.
"""


class _CounterPerSecond:
    """A counter of the events that happen in the current mission second."""

    def __init__(self) -> None:
        self._second = self._count = 0

    def add(self, count: int, now: float) -> int:
        """Add `count` to the counter. Return the total for the mission second that contains `now`."""
        self._count = count + (self._count if self._second == int(now) else 0)
        self._second = int(now)
        return self._count


@dataclass
class IncarnationRecord:
    """The recorded inputs and answers of one incarnation of an agent, as lines of text. Recording stops after `limit`
    bytes.
    """

    agent_id: int
    command: tuple[str, ...]
    after_another: bool
    """True if the program had already run another agent before this one."""
    limit: int
    exchanges: list[tuple[bytes, bytes]] = field(default_factory=list)
    length: int = 0

    def add(self, line: bytes, answer: bytes) -> None:
        if self.length < self.limit:
            self.length += len(line) + len(answer)
            self.exchanges.append((line, answer))


class ForeignAgent:
    """A foreign agent (a separate program) from a start to the next end. It implements the interface `VirtualAgent`.

    The methods raise AgentFailedError or AgentLacksError. After a failure, each input raises the same error again.
    """

    def __init__(
        self,
        mission: dict[str, Any],
        initial_data: bytes,
        settings: Settings,
        program: LineProgram,
        now: float,
        *,
        tracing: bool,
        store: DiskContents | None = None,
        key_fields: Mapping[str, Any] | None = None,
        clock: AgentClock | None = None,
        record_bytes: int,
    ) -> None:
        """Start the agent by writing its first input line.

        - `mission`: mission file (`ucp-mission/1`).
        - `store`: content of the disk with which the agent boots.
        - `key_fields`: keys of the agent in a secured mission.
        - `clock`: clock of the agent. None if it shows mission time.
        - `record_bytes`: maximum size of `record`.
        """
        self.agent_id: int = mission["agent_id"]
        self.roster: frozenset[int] = frozenset(mission["roster"])
        self.initial_data = initial_data
        self.settings = settings
        self.messages_sent = 0
        self.chain_changed_at: float | None = 0.0 if tracing else None
        self.record = IncarnationRecord(
            self.agent_id, program.command, after_another=not program.is_new, limit=record_bytes
        )
        self.failed: AgentFailedError | AgentLacksError | None = None
        self._program = program
        self._tracing = tracing
        self._now = now
        self._clock = clock
        self._timer: float | None = None
        self._timers_ended, self._datagrams_sent = _CounterPerSecond(), _CounterPerSecond()
        self._sent: list[tuple[bytes, RecordedBytes]] = []
        self._trace: list[Entry] = []
        self._completed: list[bytes] | None = [] if tracing else None
        """Hashes of the completed blocks according to the trace, or None if no trace is written."""
        self._status: AgentStatus | None = None
        """The current status of the agent, or None if the status is unknown, because an input may have changed it."""
        self._export: dict[str, Any] | None = None
        """The export at the end of the incarnation."""
        first = {
            "t": float(now),
            "mission": mission,
            "trace": tracing,
            **({"store": store[0]} if isinstance(store, tuple) else {}),
            **(key_fields or {}),
        }
        self._give_input(json.dumps(first, separators=(",", ":")), "its mission", now)

    # Inputs

    def receive_message(
        self, sender: int, sequence: int, message: Message, now: float, datagram: RecordedBytes | None = None
    ) -> None:
        self._receive((datagram or RecordedBytes(None, Datagram(sender, sequence, message))).text, now)

    def receive_datagram(self, data: bytes, now: float) -> None:
        self._receive(in_base64(data), now)

    def _receive(self, text: str, now: float) -> None:
        self._give_input(f'{{"t":{self._time_text(now)},"datagram":"{text}"}}', "a datagram", now)

    def add_event(self, event: LoggableEvent, now: float) -> None:
        event_of = f'"event_id":{event.event_id},"data":"{in_base64(event.data)}","timestamp_us":{event.timestamp_us}'
        self._give_input(f'{{"t":{self._time_text(now)},{event_of}}}', "an event", now)

    def handle_timer(self, now: float) -> None:
        if self._timers_ended.add(1, now) > MAX_TIMERS_PER_S:
            raise self._failure("hung", f"has a timer that expires repeatedly without end {self._at(now)}")
        self._give_input(f'{{"t":{self._time_text(now)},"timer":true}}', "the expiry of its timer", now)

    def begin_reconcile(self, now: float) -> None:
        command_answer = self._give_input(
            f'{{"t":{self._time_text(now)},"command":"reconcile"}}', "the command reconcile", now
        ).command_answer
        self._checked_answer("reconcile", command_answer)

    # Outputs

    def next_timer(self) -> float | None:
        return self._timer

    def silent_until(self) -> float | None:
        """Return None. For a separate program, the harness does not know how long the agent will ignore messages."""
        return None

    def outgoing(self) -> Sequence[AgentOutput]:
        sent, self._sent = self._sent, []
        outgoing: list[AgentOutput] = []
        for _, datagram in sent:
            content = datagram.content
            if isinstance(content, Datagram) and content.sender == self.agent_id:
                outgoing.append((content.sequence, content.message, datagram))
            else:
                outgoing.append((0, None, datagram))
        return outgoing

    def trace(self) -> list[Entry]:
        trace, self._trace = self._trace, []
        return trace

    # Queries about the agent

    def status(self) -> AgentStatus:
        if self._status is None:
            command_answer = self._ask("status", self._now)
            try:
                self._status = AgentStatus.model_validate(command_answer)
            except ValidationError as error:
                raise self._failure(
                    "crashed", f"its answer to the command status lacks a valid {_path_of_error(error)}"
                ) from None
        return self._status

    def known_status(self) -> AgentStatus | None:
        return None if self.failed else self.status()

    def completed(self) -> list[bytes]:
        if self._completed is not None:
            return self._completed
        if self.failed is not None:
            return []
        export = self._export if self._export is not None else self._ask_for_export(self._now)
        return [bytes.fromhex(block_hash) for block_hash in export["completed"]]

    def export(self, now: float, exported_at_us: int) -> dict[str, Any]:
        return self._export if self._export is not None else self._ask_for_export(now)

    def _ask_for_export(self, now: float) -> dict[str, Any]:
        """Request the chain export, and check that it belongs to this agent and mission."""
        export = self._ask("export", now)
        try:
            read = Export.model_validate(export)
        except ValidationError as error:
            raise self._failure(
                "crashed", f"its answer to the command export lacks a valid {_path_of_error(error)}"
            ) from None
        if read.agent_id != self.agent_id:
            raise self._failure("crashed", f"answered the command export with the export of agent {read.agent_id}")
        if read.inception.block_data != in_base64(self.initial_data):
            raise self._failure("crashed", "answered the command export with the chain of another mission")
        return export

    def stored(self, now: float) -> DiskContents:
        command_answer = self._ask("store", now)
        if "store" not in command_answer:
            raise self._failure("crashed", "answered the command store without the key `store`")
        return (command_answer["store"],)

    def end(self, now: float) -> None:
        if self._export is None and self.failed is None:
            self.status()
            self._export = self._ask_for_export(now)

    # Lines

    def _time_text(self, now: float) -> str:
        """Return the time of an input as text. The rounded time is never earlier than the time of the previous
        input.
        """
        return repr(float(max(now, self._now)))

    def _at(self, now: float) -> str:
        """Return the mission time of an input, for an error message."""
        return f"at {now if self._clock is None else self._clock.mission_s(now):g} s"

    def _ask(self, command: str, now: float) -> dict[str, Any]:
        """Send the agent a command that must not change its state, and return the answer."""
        timer = self._timer
        answer = self._exchange(f'{{"t":{self._time_text(now)},"command":"{command}"}}', f"the command {command}", now)
        if answer.sent or answer.timer != timer or any(isinstance(entry, HandlerRun) for entry in answer.trace):
            raise self._failure("crashed", f"sent messages, set a timer or ran a handler for the command {command}")
        return self._checked_answer(command, answer.command_answer)

    def _checked_answer(self, command: str, command_answer: Any) -> dict[str, Any]:
        if not isinstance(command_answer, dict):
            raise self._failure("crashed", f"gave no `answer` to the command {command}")
        if command_answer.get("ok") is False:
            error = str(command_answer.get("error", "no reason given"))
            if command_answer.get("unsupported") is True:
                raise self._lacks_error(f"refused the command {command}: {last_line(error)}")
            raise self._failure("crashed", f"refused to {command}: {last_line(error)}")
        return command_answer

    def _give_input(self, line: str, what: str, now: float) -> ForeignAnswer:
        """Give an input to the agent, and store the outputs of the agent. If the agent refuses the input, there are no
        outputs.
        """
        answer = self._exchange(line, what, now)
        if self._datagrams_sent.add(len(answer.sent), now) > MAX_SENT_PER_S:
            what = f"sent more than {MAX_SENT_PER_S} datagrams within a second, {self._at(now)}"
            raise self._failure("crashed", what)
        completed = self._check(answer.trace)
        self._status = None
        self._timer = answer.timer
        self._sent += answer.sent
        self.messages_sent += len(answer.sent)
        self._trace += answer.trace
        if self._completed is not None:
            self._completed += completed
        if any(operation.startswith("chain") for operation, _ in _changes(answer.trace)):
            self.chain_changed_at = self._now
        return answer

    def _exchange(self, line: str, what: str, now: float) -> ForeignAnswer:
        if self.failed is not None:
            raise self.failed
        given = f"{line}\n".encode("ascii")
        program = self._program
        try:
            program.write(given)
            line_read = program.read()
            answer = read_answer(line_read, tracing=self._tracing)
        except ProgramFailedError as error:
            if error.status in NO_VIRTUAL_TIME and not self.record.exchanges:
                raise self._start_error(error.status) from None
            raise self._failure(error.outcome, f"{error} after it received {what} {self._at(now)}") from None
        except AnswerError as error:
            raise self._failure("crashed", f"answered {what} {self._at(now)} {error}") from None
        except LacksError as error:
            raise self._lacks_error(last_line(str(error))) from None
        except RefusedError as error:
            raise self._failure("crashed", f"refused {what} {self._at(now)}: {last_line(str(error))}") from None
        self.record.add(given, line_read)
        self._now = max(now, self._now)
        return answer

    def _check(self, entries: list[Entry]) -> list[bytes]:
        """Check the times in the trace. Return the hashes of the blocks that the trace reports as completed."""
        for entry in entries:
            if not abs(entry.t - self._now) <= ROUNDED_S:
                raise self._failure("crashed", f"wrote t={entry.t!r} into its trace of an input at {self._now:g} s")
        try:
            return [bytes.fromhex(block) for operation, block in _changes(entries) if operation == "complete"]
        except ValueError:
            raise self._failure("crashed", "recorded a completed block whose hash is not hexadecimal") from None

    def _failure(self, outcome: Outcome, detail: str) -> AgentFailedError:
        self.failed = AgentFailedError(self.agent_id, outcome, f"{detail}{self._program.log_phrase()}")
        self._program.owes_an_answer = True  # the next lines of the program are unpredictable
        return self.failed

    def _lacks_error(self, words: str) -> AgentLacksError:
        self.failed = AgentLacksError(self.agent_id, self._program.command, words)
        self._program.owes_an_answer = True
        return self.failed

    def _start_error(self, status: int) -> AgentFailedError | AgentLacksError:
        """Return the error for a program that ended before its first answer."""
        words = self._program.last_line()
        if is_shell_error(words):
            return self._failure("crashed", f"ended by itself with status {status} ({words})")
        return self._lacks_error(
            f"with --virtual it ends with status {status}{words and ', and says: '}{words}; use --backend process, or "
            "see docs/how-to/simulate-in-virtual-time.md"
        )


def _changes(entries: list[Entry]) -> Iterator[tuple[str, str]]:
    """Yield the operation and block hash of each change in these trace lines."""
    return (change for entry in entries if isinstance(entry, HandlerRun) for change in entry.changes)


def _path_of_error(error: ValidationError) -> str:
    """Return the path of the first invalid key in an answer of the agent."""
    return f"`{'.'.join(str(part) for part in error.errors()[0]['loc'])}`"
