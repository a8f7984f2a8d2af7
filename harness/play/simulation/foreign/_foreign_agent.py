"""One life of an agent that is not ours, in virtual time: the same face as `OwnAgent`, and a program behind it.

Every input is a line to the program, and its answer tells all that one may know: what it sends, when its next timer
ends, what its trace says. What it holds it is asked for, by the commands of the control socket; these are the harness's
own questions, and no part of the mission: what the agent's trace says of them is left out.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from harness.archive.exports import Export
from harness.errors import AgentFailedError
from harness.play.agent_control import Status, is_shell_error, last_line
from harness.play.simulation._simulated_agent import Outgoing, Stored
from harness.play.simulation.foreign._answer import (
    AgentLacksError,
    Answer,
    AnswerError,
    LacksError,
    Outcome,
    RefusedError,
    read_answer,
)
from harness.play.simulation.foreign._virtual_program import Program, ProgramFailedError
from ucp.events import LoggableEvent
from ucp.messages import Datagram, Message
from ucp.settings import Settings
from ucp.trace import Entry, HandlerRun, Recorded, in_base64

MAX_TIMERS_PER_S = 10_000
"""An agent whose timers end more often in a mission second, or in one instant, hangs."""
MAX_SENT_PER_S = 5000
"""Datagrams in a mission second: more are a storm, which feeds itself where others answer."""
ROUNDED_S = 2e-6
"""The times of a trace have six digits after the point."""
NO_VIRTUAL_TIME = (2, 127)
"""Exit statuses of agents that take `--virtual` for a mission file that is wrong, or say that they lack it."""


class _PerSecond:
    """How many of something there were in this mission second."""

    def __init__(self) -> None:
        self._second = self._count = 0

    def add(self, count: int, now: float) -> int:
        """How many there are by now, with these."""
        self._count = count + (self._count if self._second == int(now) else 0)
        self._second = int(now)
        return self._count


@dataclass
class LifeRecord:
    """What an agent was given in one life, and what it answered, in lines: the first `limit` bytes of it."""

    agent_id: int
    command: tuple[str, ...]
    after_another: bool
    """Its process had played another life before."""
    limit: int
    exchanges: list[tuple[bytes, bytes]] = field(default_factory=list)
    length: int = 0

    def add(self, line: bytes, answer: bytes) -> None:
        if self.length < self.limit:
            self.length += len(line) + len(answer)
            self.exchanges.append((line, answer))


class ForeignAgent:
    """The agent of a `mission` (`ucp-mission/1`), played by `program`. Raises AgentFailedError, AgentLacksError.

    With a `store` it boots from that: (what an earlier life answered,). `handed` is what it is told of its keys.
    """

    def __init__(
        self,
        mission: dict[str, Any],
        initial_data: bytes,
        settings: Settings,
        program: Program,
        now: float,
        *,
        tracing: bool,
        store: Stored | None = None,
        handed: Mapping[str, Any] | None = None,
        record_bytes: int,
    ) -> None:
        self.agent_id: int = mission["agent_id"]
        self.roster: frozenset[int] = frozenset(mission["roster"])
        self.initial_data = initial_data
        self.settings = settings
        self.messages_sent = 0
        self.chain_changed_at: float | None = 0.0 if tracing else None
        self.record = LifeRecord(self.agent_id, program.command, after_another=not program.is_new, limit=record_bytes)
        self.failed: AgentFailedError | AgentLacksError | None = None
        self._program = program
        self._tracing = tracing
        self._now = now
        self._timer: float | None = None
        self._timers_ended, self._datagrams_sent = _PerSecond(), _PerSecond()
        self._sent: list[tuple[bytes, Recorded]] = []
        self._trace: list[Entry] = []
        self._completed: list[bytes] | None = [] if tracing else None
        """None if it has to be asked for."""
        self._status: Status | None = None
        """None if it may be another by now."""
        self._export: dict[str, Any] | None = None
        """What it left."""
        first = {
            "t": float(now),
            "mission": mission,
            "trace": tracing,
            **({"store": store[0]} if isinstance(store, tuple) else {}),
            **(handed or {}),
        }
        self._give(json.dumps(first, separators=(",", ":")), "its mission", now)

    # Inputs

    def receive_message(
        self, sender: int, sequence: int, message: Message, now: float, datagram: Recorded | None = None
    ) -> None:
        self._receive((datagram or Recorded(None, Datagram(sender, sequence, message))).text, now)

    def receive_datagram(self, data: bytes, now: float) -> None:
        self._receive(in_base64(data), now)

    def _receive(self, text: str, now: float) -> None:
        self._give(f'{{"t":{self._at(now)},"datagram":"{text}"}}', "a datagram", now)

    def add_event(self, event: LoggableEvent, now: float) -> None:
        event_of = f'"event_id":{event.event_id},"data":"{in_base64(event.data)}","timestamp_us":{event.timestamp_us}'
        self._give(f'{{"t":{self._at(now)},{event_of}}}', "an event", now)

    def handle_timer(self, now: float) -> None:
        if self._timers_ended.add(1, now) > MAX_TIMERS_PER_S:
            raise self._failure("hung", f"has a timer that expires again and again at {now:g} s")
        self._give(f'{{"t":{self._at(now)},"timer":true}}', "the expiry of its timer", now)

    def begin_reconcile(self, now: float) -> None:
        told = self._give(f'{{"t":{self._at(now)},"command":"reconcile"}}', "the command reconcile", now).told
        self._accepted("reconcile", told)

    # What comes of them

    def next_timer(self) -> float | None:
        return self._timer

    def answers_nobody_until(self) -> float | None:
        """Nobody knows."""
        return None

    def outgoing(self) -> Sequence[Outgoing]:
        sent, self._sent = self._sent, []
        outgoing: list[Outgoing] = []
        for _, datagram in sent:
            said = datagram.content
            if isinstance(said, Datagram) and said.sender == self.agent_id:
                outgoing.append((said.sequence, said.message, datagram))
            else:
                outgoing.append((0, None, datagram))
        return outgoing

    def trace(self) -> list[Entry]:
        trace, self._trace = self._trace, []
        return trace

    # What it says of itself

    def status(self) -> Status:
        if self._status is None:
            told = self._ask("status", self._now)
            try:
                self._status = Status.model_validate(told)
            except ValidationError as error:
                raise self._failure(
                    "crashed", f"answered to the command status without a proper {_where(error)}"
                ) from None
        return self._status

    def known_status(self) -> Status | None:
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
        """Its export, which is one."""
        export = self._ask("export", now)
        try:
            read = Export.model_validate(export)
        except ValidationError as error:
            raise self._failure("crashed", f"answered to the command export without a proper {_where(error)}") from None
        if read.agent_id != self.agent_id:
            raise self._failure("crashed", f"answered to the command export with that of agent {read.agent_id}")
        if read.inception.block_data != in_base64(self.initial_data):
            raise self._failure("crashed", "answered to the command export with the chain of another mission")
        return export

    def stored(self, now: float) -> Stored:
        told = self._ask("store", now)
        if "store" not in told:
            raise self._failure("crashed", "answered to the command store without `store`")
        return (told["store"],)

    def leave(self, now: float) -> None:
        if self._export is None and self.failed is None:
            self.status()
            self._export = self._ask_for_export(now)

    # Lines

    def _at(self, now: float) -> str:
        """The time of an input: rounding may make the next one a hair earlier than the last."""
        return repr(float(max(now, self._now)))

    def _ask(self, command: str, now: float) -> dict[str, Any]:
        """Something about itself, which changes nothing. Raises HarnessError."""
        timer = self._timer
        answer = self._exchange(f'{{"t":{self._at(now)},"command":"{command}"}}', f"the command {command}", now)
        if answer.sent or answer.timer != timer or any(isinstance(entry, HandlerRun) for entry in answer.trace):
            raise self._failure("crashed", f"did not only answer the command {command}")
        return self._accepted(command, answer.told)

    def _accepted(self, command: str, told: Any) -> dict[str, Any]:
        if not isinstance(told, dict):
            raise self._failure("crashed", f"gave no `answer` to the command {command}")
        if told.get("ok") is False:
            error = str(told.get("error", "no reason given"))
            if told.get("unsupported") is True:
                raise self._lacks(f"refused the command {command}: {last_line(error)}")
            raise self._failure("crashed", f"refused to {command}: {last_line(error)}")
        return told

    def _give(self, line: str, what: str, now: float) -> Answer:
        """An input, of which may come whatever it likes; nothing does of one over which it fails."""
        answer = self._exchange(line, what, now)
        if self._datagrams_sent.add(len(answer.sent), now) > MAX_SENT_PER_S:
            raise self._failure("crashed", f"sent more than {MAX_SENT_PER_S} datagrams within mission second {now:.0f}")
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

    def _exchange(self, line: str, what: str, now: float) -> Answer:
        if self.failed is not None:
            raise self.failed
        given = f"{line}\n".encode("ascii")
        program = self._program
        try:
            program.tell(given)
            said = program.answer()
            answer = read_answer(said, tracing=self._tracing)
        except ProgramFailedError as error:
            if error.status in NO_VIRTUAL_TIME and not self.record.exchanges:
                raise self._has_no_virtual_time(error.status) from None
            raise self._failure(error.outcome, f"{error} when it was given {what} at {now:g} s") from None
        except AnswerError as error:
            raise self._failure("crashed", f"answered {what} at {now:g} s {error}") from None
        except LacksError as error:
            raise self._lacks(last_line(str(error))) from None
        except RefusedError as error:
            raise self._failure("crashed", f"refused {what} at {now:g} s: {last_line(str(error))}") from None
        self.record.add(given, said)
        self._now = max(now, self._now)
        return answer

    def _check(self, entries: list[Entry]) -> list[bytes]:
        """Hashes of the blocks that were completed, as the trace says it. Raises AgentFailedError."""
        for entry in entries:
            if not abs(entry.t - self._now) <= ROUNDED_S:
                raise self._failure("crashed", f"wrote t={entry.t!r} into its trace of an input at {self._now:g} s")
        try:
            return [bytes.fromhex(block) for operation, block in _changes(entries) if operation == "complete"]
        except ValueError:
            raise self._failure("crashed", "completed a block whose hash in its trace is none") from None

    def _failure(self, outcome: Outcome, detail: str) -> AgentFailedError:
        self.failed = AgentFailedError(self.agent_id, outcome, f"{detail}{self._program.where_it_logs()}")
        self._program.owes_an_answer = True  # nobody knows what it will say next
        return self.failed

    def _lacks(self, words: str) -> AgentLacksError:
        self.failed = AgentLacksError(self.agent_id, self._program.command, words)
        self._program.owes_an_answer = True
        return self.failed

    def _has_no_virtual_time(self, status: int) -> AgentFailedError | AgentLacksError:
        """It ended before it said anything."""
        words = self._program.last_line()
        if is_shell_error(words):
            return self._failure("crashed", f"ended by itself with status {status} ({words})")
        return self._lacks(
            f"with --virtual it ends with status {status}{words and ', and says: '}{words}; use --backend process, or "
            "see docs/how-to/simulate-in-virtual-time.md"
        )


def _changes(entries: list[Entry]) -> Iterator[tuple[str, str]]:
    """Operation and block hash."""
    return (change for entry in entries if isinstance(entry, HandlerRun) for change in entry.changes)


def _where(error: ValidationError) -> str:
    """The first key that is wrong."""
    return f"`{'.'.join(str(part) for part in error.errors()[0]['loc'])}`"
