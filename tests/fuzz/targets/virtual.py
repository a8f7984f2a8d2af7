"""Fuzz target: an agent in virtual time. Each input line gets one JSON line as its answer. If the input is repeated,
the answers are the same.

The reference implementation takes the same steps, and the agent can restart from its stored data.
"""

import base64
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from harness.archive.exports import parse_export
from harness.archive.traces import TraceHeader, parse_line
from harness.play.process.agent_mission import mission_file
from tests.fuzz.finding import FailedError, require, sound
from tests.harness.virtual import scenario
from ucp.block import Block, InceptionBlock, next_chain_hash
from ucp.messages import BlockAddResponse, CommitBlock, decode, encode
from ucp.trace import in_base64
from ucp.virtual import serve

MOST_LINES = 60


def run(data: bytes) -> None:
    lines = b"".join(data.splitlines(keepends=True)[:MOST_LINES])
    answers = _answers(lines)
    require(len(answers) == len(io.BytesIO(lines).readlines()), "not one answer for each line")
    for line, answer in zip(io.BytesIO(lines), answers, strict=True):
        _judge(line, json.loads(answer, parse_constant=_no_number))
    if answers and "sent" in json.loads(answers[0]):  # it begins with a mission
        twice = _answers(lines + (b"" if lines.endswith(b"\n") else b"\n") + lines)
        require(twice[len(answers) :] == answers, "it remembers the mission before")


def _answers(lines: bytes) -> list[bytes]:
    said = io.BytesIO()
    serve(io.BytesIO(lines), said)
    return said.getvalue().splitlines()


def _judge(line: bytes, answer: dict[str, Any]) -> None:
    if "error" in answer:
        sound(answer["error"])
        return
    for sent in answer["sent"]:
        decode(base64.b64decode(sent, validate=True))
    for entry in answer.get("trace", ()):
        require(not isinstance(parse_line(json.dumps(entry).encode()), TraceHeader), "a header among what it did")
    reply = answer.get("answer", {})
    if "schema" in reply:
        parse_export(Path("reply"), reply)
    if "store" in reply:
        boots = {**json.loads(_MISSION), "store": reply["store"]}
        require("error" not in json.loads(_answers(json.dumps(boots).encode())[0]), "it does not boot from its store")


def _no_number(constant: str) -> Any:
    raise FailedError(f"{constant} is no JSON")


def _mission() -> str:
    asked = scenario(agents=3, settings={"max_block_bytes": 64, "max_event_bytes": 64})
    address = {"address": "127.0.0.1", "broadcast": "127.255.255.255"}
    document = mission_file(1, asked, 1, b"fuzz", with_vehicle=False, epoch_us=0, **address)
    return json.dumps({"t": 0, "mission": {**document, "events": {"source": "none"}, "speedup": 1}, "trace": True})


_MISSION = _mission()


def seeds(flown: Path) -> Iterator[bytes]:
    """Yield input lines for a commit, a block of another agent, a reconcile, and every command."""
    block = Block(2, 5, b"of two")
    chain_hash = next_chain_hash(InceptionBlock(b"fuzz").chain_hash, block.block_hash)
    commit = in_base64(encode(2, 0, CommitBlock(block, chain_hash)))
    vote = in_base64(encode(2, 1, BlockAddResponse(block.block_hash, True)))
    yield "\n".join(
        [
            _MISSION,
            *(json.dumps({"t": 1, "event_id": 1, "data": "AAEC" * 4, "timestamp_us": 10**6}) for _ in range(3)),
            json.dumps({"t": 2, "datagram": vote}),
            json.dumps({"t": 11, "timer": True}),
            json.dumps({"t": 12, "datagram": commit}),
            json.dumps({"t": 13, "command": "reconcile"}),
            json.dumps({"t": 14, "command": "store"}),
            json.dumps({"t": 20, "timer": True}),
            json.dumps({"t": 30, "command": "status"}),
            json.dumps({"t": 30, "command": "quirk", "name": "ignore_commit", "value": 0.5}),
            json.dumps({"t": 31, "command": "stop_events"}),
            json.dumps({"t": 40, "command": "export"}),
        ]
    ).encode()
