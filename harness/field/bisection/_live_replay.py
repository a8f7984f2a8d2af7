"""Send the recorded inputs of one agent to a different agent program over UDP, and compare its messages with the
recorded ones.

If the machine runs programs late, a correct agent can differ from its record. The harness therefore measures the delays
of the machine. If the machine was late and messages differ, the harness repeats the replay at a lower speed.

The agent runs in a lab with one other node, which simulates all its peers. This node sends the datagrams that the peers
sent according to the record, at the same times.

The agent contract has no command to log an event, so the agent program cannot log the recorded events. Instead, a peer
commits the agent's own blocks at the times at which the recorded agent committed them. If a vote of the recorded agent
led to a reconcile, a command starts this reconcile. The agent program does everything else by itself, and its messages
are compared with the record.
"""

import asyncio
import json
import os
import sys
import time
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import partial
from math import inf
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any

from harness.archive.run_journals import LAG_FILE, LagLine
from harness.archive.vocabulary import first_unknown, unknown_names
from harness.checker.recorded_inputs import decoded
from harness.checker.steps.core_in_use import settings_in_use
from harness.errors import FieldError, HarnessError, MachineError
from harness.field.bisection.outcome import RecordDifference
from harness.field.replay import RecordedTrace
from harness.play.agent_control import AgentRefusedError, AgentSilentError
from harness.play.process.agent_mission import mission_file
from harness.play.process.controlled_program import STOP_GRACE_S, ControlledProgram, ProgramEndedError
from harness.play.process.lag_meter import LagMeter
from harness.scenario import Scenario
from netem.errors import LabUnavailable, NetemError
from netem.lab import Lab
from ucp.block import MAX_AGENT_ID
from ucp.clock import MICROSECONDS
from ucp.messages import (
    BlockAddRequest,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    MalformedDatagramError,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
    encode,
)
from ucp.trace import DroppedDatagram, HandlerRun, RecordedBytes, in_base64
from ucp.trigger import LocalTrigger, MessageTrigger, OperatorTrigger

START_DELAY_S = 2.0
"""Seconds of wall time between the start of the programs and mission second 0. The program that simulates the peers
needs this time to start.
"""
SLACK_S, SLACK_WALL_S = 1.0, 0.15
"""Maximum difference between the time of a message and its recorded time. The first value is in mission seconds, the
second in seconds of wall time. The sum of both applies.
"""
MAX_PLAYS = 3
"""Maximum number of replays. Each replay has half the speed of the previous one."""
MAX_MACHINE_DELAY_S = 0.05
"""If the machine never wakes a program later than this number of seconds of wall time, it explains no difference."""
HASH_DIGITS = 12


class NotStartedError(HarnessError):
    """An error: the agent program cannot be started."""


class ReplayFailedError(HarnessError):
    """An error: the agent program ended unexpectedly, or refused a command."""


class BusyMachineError(HarnessError):
    """An error: this machine runs programs too late to attribute the differences to the agent program."""


@dataclass(frozen=True)
class ReceivedMessages:
    """The messages of the agent program, each with its mission second. `machine_delay_s` is the greatest delay of the
    machine during the replay, in seconds of wall time.
    """

    messages: list[tuple[float, Message]]
    machine_delay_s: float


@dataclass(frozen=True)
class MessageDifference:
    """A difference between the messages of the agent program and the record, at mission second `t`. `subject` is equal
    for the same difference in several replays.
    """

    t: float
    subject: tuple[Any, ...]
    reported: RecordDifference


@dataclass(frozen=True)
class ExpectedMessage:
    """A message that the recorded agent sent. The program under test should also send it."""

    t: float
    line: int
    handler: str
    message: Message


@dataclass(frozen=True)
class ScriptedDatagram:
    """A datagram that the harness sends to the agent program at mission second `t`. If the datagram is an answer to a
    query of the agent, `after` is the query, and `asked_s` is the recorded mission second of the query.
    """

    t: float
    datagram: str
    after: str | None = None
    asked_s: float = 0.0

    def to_json(self) -> dict[str, Any]:
        question = {} if self.after is None else {"after": self.after, "asked_s": self.asked_s}
        return {"t": self.t, "datagram": self.datagram, **question}


@dataclass(frozen=True)
class PeerScript:
    """A script for the simulated peers of the agent program. The script contains the datagrams and commands to send to
    the program at each mission second, and the messages that the program should send.
    """

    datagrams: list[ScriptedDatagram]
    questions: list[tuple[float, str]]
    """Mission second and datagram (in base64) of each query that the recorded agent sent."""
    reconciles: list[float]
    expected: list[ExpectedMessage]
    finished: list[float]
    """Mission seconds at which a reconcile of the recorded agent ended."""
    lines: list[tuple[float, int]]
    """Mission second and line number of each handler run in the record."""
    ends_s: float

    def line_at(self, at_s: float) -> int:
        """Return the number of the last line in the record at or before mission second `at_s`."""
        return self.lines[max(0, bisect_right(self.lines, at_s, key=itemgetter(0)) - 1)][1] if self.lines else 0

    def is_near_reconcile_end(self, at_s: float, slack_s: float) -> bool:
        """Return true if a reconcile of the recorded agent ended near this mission second. Near this time, a process
        may begin to answer queries slightly earlier or later than in the record.
        """
        index = bisect_left(self.finished, at_s - slack_s)
        return index < len(self.finished) and self.finished[index] <= at_s + slack_s


def script_of(record: RecordedTrace) -> PeerScript:
    """Return the script for the peers, up to the first restart of the recorded agent. Later inputs are omitted, because
    after a restart the agent program depends on the content of its disk.
    """
    datagrams: list[ScriptedDatagram] = []
    reconciles: list[float] = []
    expected: list[ExpectedMessage] = []
    questions: dict[tuple[type, bytes], tuple[float, str]] = {}
    sent_question: list[tuple[float, str]] = []
    finished: list[float] = []
    reconciling = False
    peer = min(member for member in record.header.roster if member != record.agent_id)
    runs = [(entry.line, entry.content) for entry in record.entries if entry.incarnation <= 1]
    for line, run in runs:
        if isinstance(run, DroppedDatagram):
            datagrams.append(ScriptedDatagram(run.t, run.datagram.text))
        elif isinstance(run, HandlerRun):
            if reconciling and not run.state.reconciling:
                finished.append(run.t)
            reconciling = run.state.reconciling
            if isinstance(run.trigger, MessageTrigger) and run.input is not None:
                datagrams.append(_scripted_answer(questions, run.t, run.input))
            if run.handler == "reconcile_begin" and run.branch == "begun" and _starts_locally(run):
                reconciles.append(run.t)
            for text, message in _messages(run):
                if (question := _question_key(message)) is not None:
                    questions[question] = run.t, text
                    sent_question.append((run.t, text))
                if run.handler == "vote_timer_expiration" and isinstance(message, CommitBlock):
                    datagrams.append(ScriptedDatagram(run.t, in_base64(encode(peer, line, message))))
                elif not isinstance(message, BlockAddRequest):
                    expected.append(ExpectedMessage(run.t, line, run.handler, message))
    datagrams.sort(key=lambda given: given.t)
    return PeerScript(
        datagrams,
        sent_question,
        reconciles,
        expected,
        finished,
        [(run.t, line) for line, run in runs],
        runs[-1][1].t if runs else 0.0,
    )


def _question_key(message: Message) -> tuple[type, bytes] | None:
    """Return two properties of a query: the type of the answer to it, and the hash of the chain or block about which it
    asks. Return None if the message is not a query.
    """
    match message:
        case ChainContainQuery():
            return ChainContainResponse, message.chain_hash
        case ChainHashSuccessorQuery():
            return NextInSequenceResponse, message.chain_hash
        case RequestForBlock():
            return BlockResponse, message.block_hash
    return None


def _scripted_answer(
    questions: Mapping[tuple[type, bytes], tuple[float, str]], t: float, datagram: RecordedBytes
) -> ScriptedDatagram:
    try:
        message = decoded(datagram).message
    except MalformedDatagramError:
        return ScriptedDatagram(t, datagram.text)
    about = message.block.block_hash if isinstance(message, BlockResponse) else getattr(message, "chain_hash", b"")
    sent_question = questions.get((type(message), about))
    return (
        ScriptedDatagram(t, datagram.text, sent_question[1], sent_question[0])
        if sent_question
        else ScriptedDatagram(t, datagram.text)
    )


def _starts_locally(run: HandlerRun) -> bool:
    return isinstance(run.trigger, OperatorTrigger) or run.trigger == LocalTrigger("vote_timer_expiration")


def _messages(run: HandlerRun) -> Iterator[tuple[str, Message]]:
    """Yield each message that the agent sent, together with its datagram in base64."""
    for sent in run.sent:
        if sent.datagram is not None:
            with suppress(MalformedDatagramError):
                yield sent.datagram.text, decoded(sent.datagram).message


def play_live(
    record: RecordedTrace, command: Sequence[str], directory: Path, *, speedup: float
) -> list[RecordDifference]:
    """Send the recorded inputs to an agent program. Return the differences between the messages of the program and the
    recorded messages. Raises MachineError, NotStartedError, ReplayFailedError. Raises BusyMachineError if the
    messages differ because the machine runs programs late. Raises FieldError if the record has unknown names.
    """
    if unknown := first_unknown(unknown_names(record.trace.runs), ("trigger", "handler", "branch", "timer")):
        raise FieldError(f"{record.path}: {unknown}, so it cannot be played; give another record")
    script = script_of(record)
    common: set[tuple[Any, ...]] | None = None
    for number in range(MAX_PLAYS):
        place = directory / f"replay-{number + 1}"
        place.mkdir()
        slower = speedup / 2**number
        received = _play_in_lab(_AgentProgramReplay(record, script, command, place, slower))
        found = sorted(_compare(script, received.messages, SLACK_S + SLACK_WALL_S * slower), key=attrgetter("t"))
        if not found or received.machine_delay_s <= MAX_MACHINE_DELAY_S:
            return [each.reported for each in found]
        subjects = {each.subject for each in found}
        common = subjects if common is None else common & subjects
    if not common:
        raise BusyMachineError(
            f"this machine woke programs up to {received.machine_delay_s:.2g} s late, so the differences may be no "
            "error of the agent; give a lower --speedup, or try again when the machine is less busy"
        )
    return [each.reported for each in found if each.subject in common]


def _play_in_lab(replay: "_AgentProgramReplay") -> ReceivedMessages:
    try:
        return asyncio.run(replay.play())
    except LabUnavailable as error:
        raise MachineError(str(error)) from None
    except NetemError as error:
        raise MachineError(f"the lab failed: {error}") from None


class _AgentProgramReplay:
    def __init__(
        self, record: RecordedTrace, script: PeerScript, command: Sequence[str], directory: Path, speedup: float
    ) -> None:
        self._record = record
        self._script = script
        self._command = command
        self._place = directory
        self._speedup = speedup
        self._peers_id = next(number for number in range(MAX_AGENT_ID, 0, -1) if number not in record.header.roster)

    async def play(self) -> ReceivedMessages:
        agent_id = self._record.agent_id
        lab = await Lab.open((agent_id, self._peers_id), log=self._place / "lab.log")
        async with lab:
            directory = self._place / "agent"
            directory.mkdir()
            (directory / f"{agent_id}.mission.json").write_text(json.dumps(self._mission(lab)))
            agent = await ControlledProgram.start(
                partial(lab.spawn, agent_id, role="agent"),
                [*self._command, f"{agent_id}.mission.json"],
                directory=directory,
                control=directory / f"{agent_id}.control",
                log=directory / f"{agent_id}.out",
            )
            try:
                await _wait_until_it_answers(agent)
                return await self._run_mission(lab, agent)
            finally:
                await agent.stop()

    def _mission(self, lab: Lab) -> dict[str, Any]:
        header = self._record.header
        scenario = Scenario.model_validate(
            {"name": "record", "agents": sorted(header.roster), "speedup": self._speedup, "vehicles": {"kind": "none"}}
        ).model_copy(update={"settings": settings_in_use(header)})
        mission = mission_file(
            self._record.agent_id,
            scenario,
            0,
            header.initial_data,
            address=lab.addresses[self._record.agent_id],
            broadcast=lab.broadcast,
            with_vehicle=False,
        )
        return {**mission, "events": {**mission["events"], "source": "none"}}

    async def _run_mission(self, lab: Lab, agent: ControlledProgram) -> ReceivedMessages:
        epoch_us = round((time.time() + START_DELAY_S) * MICROSECONDS)
        script, received = self._place / "script.jsonl", self._place / "heard.jsonl"
        lines = [given.to_json() for given in self._script.datagrams]
        lines += [{"t": at_s, "question": question} for at_s, question in self._script.questions]
        script.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
        peers = await lab.spawn(
            self._peers_id,
            [
                sys.executable,
                "-P",
                "-m",
                "harness.field.bisection._scripted_peers",
                script.name,
                received.name,
                str(epoch_us),
                str(self._speedup),
            ],
            cwd=self._place,
            env=dict(os.environ),
            stdout=self._place / "peers.log",
            stderr=self._place / "peers.log",
        )
        await _ask(agent, "start", epoch_us=epoch_us)
        meter = await LagMeter.start(self._place / LAG_FILE, epoch_us, self._speedup, lab.networks)
        commanding = asyncio.create_task(self._command_reconciles(agent, epoch_us))
        ending = asyncio.create_task(agent.process.wait())
        over_s = self._script.ends_s + SLACK_S + SLACK_WALL_S * self._speedup
        done, _ = await asyncio.wait({ending}, timeout=self._wall_s(epoch_us, over_s))
        commanding.cancel()
        await meter.stop()
        await peers.terminate(STOP_GRACE_S)
        if done:
            raise ReplayFailedError(_end_text(agent, agent.ended()))
        ending.cancel()
        return ReceivedMessages(_received(received, self._record.agent_id), _machine_delay_s(self._place / LAG_FILE))

    async def _command_reconciles(self, agent: ControlledProgram, epoch_us: int) -> None:
        for t in self._script.reconciles:
            await asyncio.sleep(self._wall_s(epoch_us, t))
            await _ask(agent, "reconcile")

    def _wall_s(self, epoch_us: int, mission_s: float) -> float:
        """Return the seconds of wall time from now until a mission second."""
        return max(0.0, epoch_us / MICROSECONDS + mission_s / self._speedup - time.time())


async def _wait_until_it_answers(agent: ControlledProgram) -> None:
    try:
        await agent.ready()
    except ProgramEndedError as error:
        raise NotStartedError(_end_text(agent, error)) from None
    except AgentSilentError as error:
        raise NotStartedError(f"the agent {error}") from None


async def _ask(agent: ControlledProgram, command: str, **arguments: Any) -> None:
    try:
        await agent.ask(command, **arguments)
    except (AgentSilentError, AgentRefusedError) as error:
        raise ReplayFailedError(f"the agent does not {command}: {error}") from None


def _end_text(agent: ControlledProgram, error: ProgramEndedError) -> str:
    return f"the agent {error}: {agent.last_line or 'it printed nothing'}"


def _received(path: Path, agent_id: int) -> list[tuple[float, Message]]:
    received: list[tuple[float, Message]] = []
    for text in path.read_text(encoding="utf-8").splitlines():
        line = json.loads(text)
        try:
            datagram = decoded(RecordedBytes(line["datagram"]))
        except MalformedDatagramError:
            continue
        if datagram.sender == agent_id and not isinstance(datagram.message, BlockAddRequest):
            received.append((float(line["t"]), datagram.message))
    return received


def _machine_delay_s(path: Path) -> float:
    """Return the greatest delay in a file that the lag meter wrote, in seconds of wall time. An empty file measures
    nothing, so the delay can have any value.
    """
    lines = path.read_text(encoding="ascii").splitlines()
    return max((LagLine.model_validate_json(line).machine_s for line in lines), default=inf)


def _compare(script: PeerScript, received: list[tuple[float, Message]], slack_s: float) -> Iterator[MessageDifference]:
    """Yield each message that is missing, different or unexpected. Near the end of a reconcile, missing and unexpected
    messages are not reported, because an agent does not answer during a reconcile.
    """
    unmatched = list(received)
    for expected_message in script.expected:
        candidates = [each for each in unmatched if abs(each[0] - expected_message.t) <= slack_s]
        equal_message = next((each for each in candidates if each[1] == expected_message.message), None)
        if equal_message is not None:
            unmatched.remove(equal_message)
            continue
        same_subject = next(
            (each for each in candidates if _subject(each[1]) == _subject(expected_message.message)), None
        )
        if same_subject is not None:
            unmatched.remove(same_subject)
        elif script.is_near_reconcile_end(expected_message.t, slack_s):
            continue
        did = f"it sent {_message_text(same_subject[1])}" if same_subject is not None else "it did not send it"
        detail = f"{did}; the record sent {_message_text(expected_message.message)}, at {expected_message.t:g} s"
        yield MessageDifference(
            expected_message.t,
            (expected_message.line, None if same_subject is None else same_subject[1]),
            RecordDifference(line=expected_message.line, handler=expected_message.handler, detail=detail),
        )
    for t, message in unmatched:
        if not script.is_near_reconcile_end(t, slack_s):
            detail = f"it sent {_message_text(message)} at {t:.1f} s; the record has no such message"
            reported = RecordDifference(line=script.line_at(t), handler=None, detail=detail)
            yield MessageDifference(t, (None, message), reported)


def _subject(message: Message) -> tuple[type, Any]:
    """Return the type of a message and the block or chain that the message concerns."""
    for name in ("chain_hash", "block_hash"):
        if type(message).__name__ == "BlockAddResponse" and name == "chain_hash":
            continue
        if (value := getattr(message, name, None)) is not None:
            return type(message), value
    return type(message), None


def _message_text(message: Message) -> str:
    """Return a text about a message, such as "Block Add Response (block hash 5f0c…, approve True)"."""
    parts = []
    for each in fields(message):
        value = getattr(message, each.name)
        shown = value.hex()[:HASH_DIGITS] if isinstance(value, bytes) else value
        if each.name == "block":
            shown = value.block_hash.hex()[:HASH_DIGITS]
        if value is not None:
            parts.append(f"{each.name.replace('_', ' ')} {shown}")
    return f"{message.NAME} ({', '.join(parts)})"
