"""One agent's record, given to another agent as a process, datagram for datagram, by UDP.

The agent is alone in a lab but for one node that plays all its peers: it sends what the record says that they sent, at
these times. The record's own events cannot be logged by another agent, for a mission has no word for that. So a block
of the agent's own comes to it as committed by a peer, at the moment at which the record committed it, and a reconcile
that came of a vote of its own is commanded. All else the agent does by itself, and its messages are compared with the
record's.
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
from operator import itemgetter
from pathlib import Path
from typing import Any

from harness.archive.vocabulary import first_unknown, unknown_names
from harness.checker.recorded_inputs import decoded
from harness.errors import FieldError, HarnessError, MachineError
from harness.field.bisection.outcome import Difference
from harness.field.replay import Record
from harness.play.agent_control import AgentControl, AgentRefusedError, AgentSilentError
from harness.play.process.agent_mission import mission_file
from harness.scenario import Scenario
from netem.errors import LabUnavailable, NetemError
from netem.lab import Lab, LabProcess
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
from ucp.trace import Dropped, HandlerRun, Recorded, in_base64
from ucp.trigger import LocalTrigger, MessageTrigger, OperatorTrigger

START_LIMIT_S, ANSWER_LIMIT_S, GRACE_S = 30.0, 10.0, 5.0
HEAD_START_S = 2.0
"""By when those who play the peers are there."""
SLACK_S, SLACK_WALL_S = 1.0, 0.15
"""How far in time a message may be from the record's, in mission seconds, and more in wall seconds."""
SHOWN = 12


class NotStartedError(HarnessError):
    """The agent does not start."""


class ReplayFailedError(HarnessError):
    """The agent ends by itself, or does not do as it is told."""


@dataclass(frozen=True)
class Said:
    """A message that the record's agent sent, as it should be heard."""

    t: float
    line: int
    handler: str
    message: Message


@dataclass(frozen=True)
class Given:
    """A datagram that the agent is given; `after` is the question of its own that it answers, if it does."""

    t: float
    datagram: str
    after: str | None = None
    asked_s: float = 0.0

    def to_json(self) -> dict[str, Any]:
        question = {} if self.after is None else {"after": self.after, "asked_s": self.asked_s}
        return {"t": self.t, "datagram": self.datagram, **question}


@dataclass(frozen=True)
class Script:
    """What the agent is given: datagrams and commands by mission second; and what it should say."""

    datagrams: list[Given]
    questions: list[tuple[float, str]]
    """When it asked what: datagrams in base64."""
    reconciles: list[float]
    expected: list[Said]
    finished: list[float]
    """When a reconcile ended."""
    lines: list[tuple[float, int]]
    """When which line of the record was."""
    ends_s: float

    def line_at(self, at_s: float) -> int:
        """The record's last line by then."""
        return self.lines[max(0, bisect_right(self.lines, at_s, key=itemgetter(0)) - 1)][1] if self.lines else 0

    def is_close(self, at_s: float, slack_s: float) -> bool:
        """Whether that is so near to the end of a reconcile that a process may, or may not yet, answer."""
        place = bisect_left(self.finished, at_s - slack_s)
        return place < len(self.finished) and self.finished[place] <= at_s + slack_s


def script_of(record: Record) -> Script:
    """The first life of the record; another one would begin with what was on a disk."""
    datagrams: list[Given] = []
    reconciles: list[float] = []
    expected: list[Said] = []
    questions: dict[tuple[type, bytes], tuple[float, str]] = {}
    asked: list[tuple[float, str]] = []
    finished: list[float] = []
    reconciling = False
    peer = min(member for member in record.header.roster if member != record.agent_id)
    runs = [(entry.line, entry.what) for entry in record.entries if entry.life <= 1]
    for line, run in runs:
        if isinstance(run, Dropped):
            datagrams.append(Given(run.t, run.datagram.text))
        elif isinstance(run, HandlerRun):
            if reconciling and not run.state.reconciling:
                finished.append(run.t)
            reconciling = run.state.reconciling
            if isinstance(run.trigger, MessageTrigger) and run.input is not None:
                datagrams.append(_answering(questions, run.t, run.input))
            if run.handler == "reconcile_begin" and run.branch == "begun" and _by_itself(run):
                reconciles.append(run.t)
            for text, message in _messages(run):
                if (question := _question(message)) is not None:
                    questions[question] = run.t, text
                    asked.append((run.t, text))
                if run.handler == "vote_timer_expiration" and isinstance(message, CommitBlock):
                    datagrams.append(Given(run.t, in_base64(encode(peer, line, message))))
                elif not isinstance(message, BlockAddRequest):
                    expected.append(Said(run.t, line, run.handler, message))
    datagrams.sort(key=lambda given: given.t)
    return Script(
        datagrams,
        asked,
        reconciles,
        expected,
        finished,
        [(run.t, line) for line, run in runs],
        runs[-1][1].t if runs else 0.0,
    )


def _question(message: Message) -> tuple[type, bytes] | None:
    """The type of what answers it, and what about; None if it asks nothing."""
    match message:
        case ChainContainQuery():
            return ChainContainResponse, message.chain_hash
        case ChainHashSuccessorQuery():
            return NextInSequenceResponse, message.chain_hash
        case RequestForBlock():
            return BlockResponse, message.block_hash
    return None


def _answering(questions: Mapping[tuple[type, bytes], tuple[float, str]], t: float, datagram: Recorded) -> Given:
    try:
        message = decoded(datagram).message
    except MalformedDatagramError:
        return Given(t, datagram.text)
    about = message.block.block_hash if isinstance(message, BlockResponse) else getattr(message, "chain_hash", b"")
    asked = questions.get((type(message), about))
    return Given(t, datagram.text, asked[1], asked[0]) if asked else Given(t, datagram.text)


def _by_itself(run: HandlerRun) -> bool:
    return isinstance(run.trigger, OperatorTrigger) or run.trigger == LocalTrigger("vote_timer_expiration")


def _messages(run: HandlerRun) -> Iterator[tuple[str, Message]]:
    """What it sent, with its datagrams in base64."""
    for sent in run.sent:
        if sent.datagram is not None:
            with suppress(MalformedDatagramError):
                yield sent.datagram.text, decoded(sent.datagram).message


def play_live(record: Record, command: Sequence[str], place: Path, *, speedup: float) -> list[Difference]:
    """What the agent says otherwise than the record.

    Raises MachineError, NotStartedError, ReplayFailedError; FieldError if the record is in words that nobody knows.
    """
    if unknown := first_unknown(unknown_names(record.trace.runs), ("trigger", "handler", "branch", "timer")):
        raise FieldError(f"{record.path}: {unknown}, so it cannot be played; give another record")
    script = script_of(record)
    try:
        heard = asyncio.run(_Air(record, script, command, place, speedup).play())
    except LabUnavailable as error:
        raise MachineError(str(error)) from None
    except NetemError as error:
        raise MachineError(f"the lab failed: {error}") from None
    found = sorted(_compare(script, heard, SLACK_S + SLACK_WALL_S * speedup), key=itemgetter(0))
    return [difference for _, difference in found]


class _Air:
    def __init__(self, record: Record, script: Script, command: Sequence[str], place: Path, speedup: float) -> None:
        self._record = record
        self._script = script
        self._command = command
        self._place = place
        self._speedup = speedup
        self._peers_id = next(number for number in range(MAX_AGENT_ID, 0, -1) if number not in record.header.roster)

    async def play(self) -> list[tuple[float, Message]]:
        agent_id = self._record.agent_id
        lab = await Lab.open((agent_id, self._peers_id), log=self._place / "lab.log")
        async with lab:
            directory = self._place / "agent"
            directory.mkdir()
            (directory / f"{agent_id}.mission.json").write_text(json.dumps(self._mission(lab)))
            log = directory / f"{agent_id}.out"
            agent = await lab.spawn(
                agent_id,
                [*self._command, f"{agent_id}.mission.json"],
                cwd=directory,
                env=dict(os.environ),
                stdout=log,
                stderr=log,
            )
            control = AgentControl(directory / f"{agent_id}.control")
            try:
                await self._wait_until_it_answers(control, agent, log)
                return await self._fly(lab, control, agent, log)
            finally:
                control.close()
                await agent.terminate(GRACE_S)

    def _mission(self, lab: Lab) -> dict[str, Any]:
        header = self._record.header
        scenario = Scenario.model_validate(
            {"name": "record", "agents": sorted(header.roster), "speedup": self._speedup, "vehicles": {"kind": "none"}}
        ).model_copy(update={"settings": header.settings})
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

    async def _wait_until_it_answers(self, control: AgentControl, agent: LabProcess, log: Path) -> None:
        deadline = time.monotonic() + START_LIMIT_S
        while True:
            try:
                await control.ask("status", timeout_s=ANSWER_LIMIT_S)
                return
            except AgentSilentError:
                if agent.returncode is not None:
                    raise NotStartedError(f"the agent ended with {agent.end}: {_last_line(log)}") from None
                if time.monotonic() > deadline:
                    raise NotStartedError(f"the agent did not answer within {START_LIMIT_S:g} s") from None
                await asyncio.sleep(0.02)

    async def _fly(self, lab: Lab, control: AgentControl, agent: LabProcess, log: Path) -> list[tuple[float, Message]]:
        epoch_us = round((time.time() + HEAD_START_S) * MICROSECONDS)
        script, heard = self._place / "script.jsonl", self._place / "heard.jsonl"
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
                heard.name,
                str(epoch_us),
                str(self._speedup),
            ],
            cwd=self._place,
            env=dict(os.environ),
            stdout=self._place / "peers.log",
            stderr=self._place / "peers.log",
        )
        await self._ask(control, "start", epoch_us=epoch_us)
        commanding = asyncio.create_task(self._command_reconciles(control, epoch_us))
        ending = asyncio.create_task(agent.wait())
        over_s = self._script.ends_s + SLACK_S + SLACK_WALL_S * self._speedup
        done, _ = await asyncio.wait({ending}, timeout=self._wall_s(epoch_us, over_s))
        commanding.cancel()
        await peers.terminate(GRACE_S)
        if done:
            raise ReplayFailedError(f"the agent ended by itself with {agent.end}: {_last_line(log)}")
        ending.cancel()
        return _heard(heard, self._record.agent_id)

    async def _command_reconciles(self, control: AgentControl, epoch_us: int) -> None:
        for t in self._script.reconciles:
            await asyncio.sleep(self._wall_s(epoch_us, t))
            await self._ask(control, "reconcile")

    async def _ask(self, control: AgentControl, command: str, **arguments: Any) -> None:
        try:
            await control.ask(command, timeout_s=ANSWER_LIMIT_S, **arguments)
        except (AgentSilentError, AgentRefusedError) as error:
            raise ReplayFailedError(f"the agent does not {command}: {error}") from None

    def _wall_s(self, epoch_us: int, mission_s: float) -> float:
        """From now on until then."""
        return max(0.0, epoch_us / MICROSECONDS + mission_s / self._speedup - time.time())


def _heard(path: Path, agent_id: int) -> list[tuple[float, Message]]:
    heard: list[tuple[float, Message]] = []
    for text in path.read_text(encoding="utf-8").splitlines():
        line = json.loads(text)
        try:
            datagram = decoded(Recorded(line["datagram"]))
        except MalformedDatagramError:
            continue
        if datagram.sender == agent_id and not isinstance(datagram.message, BlockAddRequest):
            heard.append((float(line["t"]), datagram.message))
    return heard


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n") if log.exists() else []
    return next((line.strip()[:200] for line in reversed(lines) if line.strip()), "it said nothing")


def _compare(script: Script, heard: list[tuple[float, Message]], slack_s: float) -> Iterator[tuple[float, Difference]]:
    """What is lacking, or said otherwise, and what nobody should have heard, with the mission second of each.

    Who reconciles answers nobody: what is, or is not, answered around the end of a reconcile is no difference.
    """
    left = list(heard)
    for said in script.expected:
        near = [each for each in left if abs(each[0] - said.t) <= slack_s]
        same = next((each for each in near if each[1] == said.message), None)
        if same is not None:
            left.remove(same)
            continue
        other = next((each for each in near if _about(each[1]) == _about(said.message)), None)
        if other is not None:
            left.remove(other)
        elif script.is_close(said.t, slack_s):
            continue
        did = f"it sent {_words(other[1])}" if other is not None else "it did not send it"
        detail = f"{did}; the record sent {_words(said.message)}, at {said.t:g} s"
        yield said.t, Difference(line=said.line, handler=said.handler, detail=detail)
    for t, message in left:
        if not script.is_close(t, slack_s):
            detail = f"it sent {_words(message)} at {t:.1f} s; the record has no such message"
            yield t, Difference(line=script.line_at(t), handler=None, detail=detail)


def _about(message: Message) -> tuple[type, Any]:
    """What a message is an answer to."""
    for name in ("chain_hash", "block_hash"):
        if type(message).__name__ == "BlockAddResponse" and name == "chain_hash":
            continue
        if (value := getattr(message, name, None)) is not None:
            return type(message), value
    return type(message), None


def _words(message: Message) -> str:
    """ "Block Add Response (block hash 5f0c…, approve True)"."""
    parts = []
    for each in fields(message):
        value = getattr(message, each.name)
        shown = value.hex()[:SHOWN] if isinstance(value, bytes) else value
        if each.name == "block":
            shown = value.block_hash.hex()[:SHOWN]
        if value is not None:
            parts.append(f"{each.name.replace('_', ' ')} {shown}")
    return f"{message.NAME} ({', '.join(parts)})"
