"""Test cases about records. The trace, chain export and status of an agent must agree with the events of the test, and
with each other.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from harness.archive.exports import Export, read_export
from harness.archive.trace_files import SUFFIX
from harness.archive.traces import Trace, read_trace
from harness.checker import records, steps
from harness.checker.evidence import Evidence
from harness.checker.judgement import Judgement
from harness.conformance._reference_model import INITIAL_DATA, PEERS, ROSTER, STRANGER
from harness.conformance._state_space import VARIANTS
from harness.conformance.cases._bench import (
    INCEPTION,
    SPEEDUP,
    CannotJudgeError,
    CaseBench,
    WrongBehaviourError,
    case,
    require,
)
from harness.errors import ExportError
from ucp.block import Block, next_chain_hash
from ucp.clock import MICROSECONDS
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    CommitBlock,
    RequestForBlock,
)
from ucp.trace import DroppedDatagram, RecordedBytes

SETTINGS = {**VARIANTS["default"].settings.to_json(), "max_block_bytes": 1024, "max_event_bytes": 267}
LARGEST_EVENT = bytes(256)
EVENTS_OF_A_BLOCK = 3
MOMENT_S = 1.0
"""Maximum difference in mission seconds between the clocks of the harness and of the agent."""


@dataclass(frozen=True)
class _CaseRecords:
    trace: Trace
    export: Export
    status: dict[str, Any]
    to_agent: Sequence[tuple[float, bytes]]
    """Mission second and content of each datagram that was sent to the agent."""
    sent: Sequence[bytes]
    export_s: tuple[float, float]
    """The mission seconds directly before and directly after the command `export`."""
    epoch_us: int

    def require_verdict(self, judgement: Judgement, bad: str, expected: str) -> None:
        found = judgement.evidence[0].detail if judgement.evidence else judgement.reason
        require(judgement.verdict != bad, expected, found)

    def evidence(self) -> Evidence:
        agent_id = self.export.agent_id
        return Evidence({agent_id: self.export}, {agent_id: self.trace})


async def _play_recorded_mission(bench: CaseBench) -> _CaseRecords:
    """Run a mission with handler runs of every kind. Then kill the agent, and return its records."""
    async with bench.agent({"settings": SETTINGS, "roster": [*ROSTER, *PEERS]}) as agent:
        first, second, *_ = PEERS
        block = Block(first, 1, b"block")
        top = next_chain_hash(INCEPTION, block.block_hash)
        agent.send(first, CommitBlock(block, top))
        agent.peer_socket.send(b"UC")
        agent.send(STRANGER, ChainContainQuery(top))
        agent.send(second, RequestForBlock(block.block_hash))
        await agent.receive_one(BlockResponse, "a Request for Block")
        for _ in range(EVENTS_OF_A_BLOCK):
            await agent.log(LARGEST_EVENT)
        proposed = await agent.receive_one(BlockAddRequest, "events that fill a block")
        agent.send(first, BlockAddResponse(proposed.block_hash, True))
        await agent.receive_one(CommitBlock, "an approved vote")
        await agent.process.ask("reconcile")
        query = await agent.receive_one(ChainContainQuery, "the command reconcile")
        agent.send(first, ChainContainResponse(query.chain_hash, False))
        await agent.receive_one(ChainContainQuery, "an agent disagrees")
        await agent.receive_one(CommitBlock, "a reconcile without further answers")
        await agent.log(b"event of the next block")
        await agent.process.ask("stop_events")
        before_s = agent.mission_s()
        await agent.process.ask("export")
        export_s = before_s, agent.mission_s()
        status = await agent.status()
        directory, agent_id = agent.process.directory, agent.agent_id
        record, epoch_s, epoch_us = list(agent.peer_socket.record), agent.epoch_s, agent.epoch_us
        path = directory / f"{agent_id}{SUFFIX}"
        if not path.exists():
            raise CannotJudgeError("the agent writes no trace")
    trace = read_trace(path)
    if trace is None:
        raise WrongBehaviourError("a trace with a valid first line", "its first line is missing or invalid")
    require(trace.problem is None, "a trace that can be read", trace.problem)
    try:
        export = read_export(directory / f"{agent_id}.chain.json")
    except ExportError as error:
        raise WrongBehaviourError("a chain export that can be read", str(error)) from None
    to_agent = [((at_s - epoch_s) * SPEEDUP, data) for at_s, by_agent, data in record if not by_agent]
    sent = [data for _, by_agent, data in record if by_agent]
    return _CaseRecords(trace, export, status, to_agent, sent, export_s, epoch_us)


def _bytes(recorded: RecordedBytes | None) -> bytes:
    return base64.b64decode(recorded.text) if recorded is not None else b""


@case("the trace has each datagram, event and command, in order and with its time", "contract, Trace")
async def _inputs(bench: CaseBench) -> None:
    played = await _play_recorded_mission(bench)
    runs, asides = played.trace.runs, [aside for _, aside in played.trace.asides]
    drops = {aside.datagram.text: aside.dropped for aside in asides if isinstance(aside, DroppedDatagram)}
    to_agent = dict.fromkeys(data for _, data in played.to_agent)
    expected = {base64.b64encode(b"UC").decode(): "truncated"}
    stranger = next(data for data in to_agent if data[4:8] == STRANGER.to_bytes(4, "big"))
    expected[base64.b64encode(stranger).decode()] = "sender not on the roster"
    require(drops == expected, f"lines for 2 dropped datagrams: {', '.join(expected.values())}", drops)
    received = [(run.t, _bytes(run.input)) for run in runs if run.trigger.kind == "message"]
    handled = [data for _, data in played.to_agent if base64.b64encode(data).decode() not in expected]
    require([data for _, data in received] == handled, f"lines for {len(handled)} messages", f"{len(received)} lines")
    for t, data in received:
        sent_s = next(at_s for at_s, each in played.to_agent if each == data)
        late_s = t - sent_s
        right = late_s > -MOMENT_S and t <= played.export_s[1]
        require(right, f"`t` {sent_s:.1f} or a little later for a message of that mission second", t)
    sent = [_bytes(sent.datagram) for run in runs for sent in run.sent]
    require(sent == played.sent, f"lines with {len(played.sent)} sent messages", f"{len(sent)} messages")
    events = sum(run.trigger.kind == "event" for run in runs)
    require(events == EVENTS_OF_A_BLOCK + 1, f"{EVENTS_OF_A_BLOCK + 1} lines for events", events)
    commands = [aside.command for aside in asides if not isinstance(aside, DroppedDatagram)]
    require(commands == ["stop_events", "export"], "lines for the commands stop_events and export", commands)


@case("the first line of the trace describes the mission", "contract, Trace")
async def _header(bench: CaseBench) -> None:
    played = await _play_recorded_mission(bench)
    header = played.trace.header
    require(sorted(header.roster) == sorted(ROSTER), f"each agent of {list(ROSTER)} once", header.roster)
    require(header.initial_data == base64.b64encode(INITIAL_DATA).decode(), "the initial data", header.initial_data)
    lacking = {name: value for name, value in SETTINGS.items() if header.settings.get(name) != value}
    require(not lacking, "the settings of the mission", f"other values of {', '.join(lacking)}")
    clock = {"epoch_us": played.epoch_us, "speedup": SPEEDUP}
    require(header.clock == clock, f"the clock {clock}", header.clock)


@case("each handler run in the trace follows Algorithms 1 to 20", "contract, Trace")
async def _steps(bench: CaseBench) -> None:
    played = await _play_recorded_mission(bench)
    played.require_verdict(steps.check(played.evidence()), "deviates", "the steps of the reference")


@case("status, chain export and trace agree", "contract, Judgement")
async def _agree(bench: CaseBench) -> None:
    played = await _play_recorded_mission(bench)
    status, trace, export = played.status, played.trace, played.export
    runs = len(trace.runs)
    require(status["handled"] == runs, f"`handled` {runs}, the number of lines of handler runs", status["handled"])
    sent_bytes = sum(map(len, played.sent))
    require(status["bytes_sent"] == sent_bytes, f"`bytes_sent` {sent_bytes}", status["bytes_sent"])
    drops = trace.dropped()
    require(status.get("dropped", drops) == drops, f"`dropped` {dict(drops)}", status.get("dropped"))
    completed = trace.completed()
    require(export.completed == completed, "the completed blocks of the trace in the export", export.completed)
    at_s = (export.exported_at_us - played.epoch_us) / MICROSECONDS
    earliest, latest = played.export_s
    in_time = earliest - MOMENT_S <= at_s <= latest + MOMENT_S
    require(in_time, f"`exported_at_us` at mission second {earliest:.1f}", f"{at_s:.1f}")
    current = base64.b64decode(export.current_block.event_data)
    require(current.endswith(b"event of the next block"), "the event of the unfinished block", f"{len(current)} bytes")
    played.require_verdict(records.check(played.evidence()), "contradict", "records that agree")
