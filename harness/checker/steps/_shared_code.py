"""Check the code that the judge shares with the agents, if a user has edited this code.

The reference has its own algorithms, state and settings. The reference and the agents share only the formats of their
data: hashes, the codec of messages and events, and the format of traces. An edit of this shared code could change the
agents and the judge alike, so that no step differs. The test vectors of the agent contract show such an edit, because
they contain the correct bytes. The vectors also contain the settings, whose defaults an edit could change for all
agents.

An installation without an edit needs no check, because the tests of the project compare the code with the vectors.
"""

import base64
import json
from collections.abc import Iterator
from dataclasses import asdict
from functools import cache
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import ucp
from harness.archive.traces import parse_line
from harness.checker.reference.state import Settings as ReferenceSettings
from harness.play.core_version import edited_files
from ucp.block import Block, InceptionBlock, next_chain_hash
from ucp.events import LoggableEvent, decode_event
from ucp.messages import Datagram, MalformedDatagramError, decode, encode
from ucp.settings import Settings
from ucp.trace import HandlerRun, RecordedBytes, SentMessage
from ucp.trigger import MessageTrigger

SHARED = ("_dataclass", "block", "events", "messages", "plain_file", "sealed", "trace", "trigger", "wire")
"""The modules of `ucp` that the judge imports, together with the modules that these modules import."""
NAME_A_BLOCK = ("block_hash", "block")
"""Fields of a message that name a block."""
VECTORS = Path(ucp.__file__).parent / "contract" / "vectors"
OF_THE_ROSTER = ("own sender", "sender not on the roster", "block not of the roster")
"""Reasons for which an agent drops a datagram that the codec accepts. The codec cannot detect them, because it does not
know the roster, the list of all agents.
"""


@cache
def edited() -> tuple[str, ...]:
    """Return the shared files that a user has edited, such as "ucp/trace.py". Shared files contain the code that judge
    and agents share. The file with the settings also counts as shared.
    """
    checked = {f"ucp/{name}.py" for name in (*SHARED, "settings")}
    return tuple(file for file in edited_files() if file in checked)


@cache
def defect() -> str | None:
    """Return a sentence about the first test vector that the edited shared code contradicts. Return None if the code
    agrees with all vectors.
    """
    if not edited():
        return None
    try:
        found = next(_contradictions(), None)
    except (ArithmeticError, AssertionError, AttributeError, LookupError, TypeError, ValueError) as error:
        found = f"its code fails with {type(error).__name__}: {str(error)[:100]}"
    return found and f"{' and '.join(edited())} was edited and contradicts the agent contract: {found}"


def broken_files() -> str | None:
    """Return the names of the edited shared files if a test vector contradicts them. Return None otherwise."""
    return " and ".join(edited()) if defect() is not None else None


def _contradictions() -> Iterator[str]:
    yield from _hashes()
    yield from _messages()
    yield from _drops()
    yield from _missions()
    ours, theirs = asdict(ReferenceSettings()), Settings()
    for name, default in ours.items():
        if getattr(theirs, name) != default:
            yield f"the default of {name} is {getattr(theirs, name)}, and that of the reference is {default}"


def _hashes() -> Iterator[str]:
    vectors = _vectors("hashes")
    for vector in vectors["inception"]:
        inception = InceptionBlock(_bytes(vector["initial_data"]))
        if (inception.block_hash.hex(), inception.chain_hash.hex()) != (vector["block_hash"], vector["chain_hash"]):
            yield "the hashes of an inception block are wrong"
    for vector in vectors["events"]:
        event, encoded = _event(vector), _bytes(vector["encoded"])
        if event.encode() != encoded or decode_event(encoded, 0) != (event, len(encoded)):
            yield f"event {vector['event_id']} is encoded or decoded incorrectly"
    for vector in vectors["blocks"]:
        block = _block(vector)
        if (block.block_data(), block.block_hash.hex()) != (_bytes(vector["block_data"]), vector["block_hash"]):
            yield f"the hash of a block of agent {vector['agent_id']} is wrong"
    for vector in vectors["chains"]:
        chain_hash = InceptionBlock(_bytes(vector["initial_data"])).chain_hash
        for block in vector["blocks"]:
            chain_hash = next_chain_hash(chain_hash, bytes.fromhex(block["block_hash"]))
            if chain_hash.hex() != block["chain_hash"]:
                yield "the chain hash of a chain is wrong"


def _messages() -> Iterator[str]:
    datagrams: list[Datagram] = []
    for vector in _vectors("messages"):
        datagram = _bytes(vector["datagram"])
        sender, sequence, message = decoded = decode(datagram)
        fields = {name: _field(value) for name, value in vector["fields"].items()}
        values = {name: getattr(message, name) for name in fields}
        expected = vector["message"], vector["sender"], vector["sequence"], fields
        if (message.NAME, sender, sequence, values) != expected:
            yield f"a {vector['message']} is decoded incorrectly"
        if encode(sender, sequence, message) != datagram:
            yield f"a {vector['message']} is encoded incorrectly"
        if decode(datagram) != decoded:
            yield f"two equal messages of the type {vector['message']} count as different"
        sent = SentMessage.of(sender, sequence, message)
        named = [value.block_hash if isinstance(value, Block) else value for value in map(fields.get, NAME_A_BLOCK)]
        about = next((block_hash.hex() for block_hash in named if block_hash is not None), None)
        if (sent.message, sent.seq, sent.block) != (message.NAME, sequence, about):
            yield f"a sent {vector['message']} is recorded incorrectly"
        if sent.datagram is None or sent.datagram.text != vector["datagram"]:
            yield f"the datagram of a sent {vector['message']} is recorded incorrectly"
        datagrams.append(decoded)
    for one, other in combinations(datagrams, 2):
        if one.message == other.message:
            yield f"a {one.message.NAME} and another {other.message.NAME} count as equal"


def _drops() -> Iterator[str]:
    for vector in _vectors("drops")["datagrams"]:
        try:
            decode(_bytes(vector["datagram"]))
            reason = None
        except MalformedDatagramError as error:
            reason = error.reason
        expected = vector["dropped"]
        if reason != (None if expected in OF_THE_ROSTER else expected):
            yield f"a datagram ({vector['what']}) is dropped as {reason}, and not as {expected}"


def _missions() -> Iterator[str]:
    if RecordedBytes("AA==") == RecordedBytes("AQ==") or RecordedBytes("AA==") != RecordedBytes("AA=="):
        yield "recorded bytes are compared incorrectly"
    for path in sorted(VECTORS.glob("missions/*.jsonl")):
        entries = []
        for text in path.read_text("ascii").splitlines():
            exchange = json.loads(text)
            settings = exchange["input"].get("mission", {}).get("settings")
            if settings is not None and Settings(**settings).to_json() != settings:
                yield f"the settings of the mission {path.stem} are written incorrectly"
            for recorded in exchange["output"].get("trace", ()):
                entry = parse_line(json.dumps(recorded).encode("ascii"))
                if json.loads(entry.to_line()) != recorded:
                    yield f"a trace line of the mission {path.stem} is read or written incorrectly"
                if isinstance(entry, HandlerRun):
                    if not _is_read(entry, recorded):
                        yield f"a run of {recorded['handler']} in the mission {path.stem} is read incorrectly"
                    entries.append(entry)
        for one, other in pairwise(entries):
            if one == other:
                yield f"two different trace lines of the mission {path.stem} count as equal"


def _is_read(run: HandlerRun, recorded: dict[str, Any]) -> bool:
    """Return true if a handler run contains the values of the trace line from which it was read."""
    trigger: dict[str, Any] = recorded["trigger"]
    kind = next(iter(trigger))
    if (run.trigger.kind, run.trigger.subject) != (kind, trigger[kind]):
        return False
    if isinstance(run.trigger, MessageTrigger) and (
        (run.trigger.message, run.trigger.sender, run.trigger.sequence)
        != (trigger["message"], trigger["from"], trigger["seq"])
    ):
        return False
    sent = [
        {"message": one.message, "seq": one.seq, "block": one.block, "datagram": one.datagram and one.datagram.text}
        for one in run.sent
    ]
    values = {
        **{name: getattr(run, name) for name in ("t", "handler", "algorithm", "branch", "tally", "started")},
        "changes": [list(change) for change in run.changes],
        "sent": sent,
        "input": run.input and run.input.text,
        "sealed": run.sealed and run.sealed.text,
        "state": {name: getattr(run.state, name) for name in recorded["state"]},
    }
    return all(recorded.get(name) == value for name, value in values.items())


def _vectors(name: str) -> Any:
    return json.loads((VECTORS / f"{name}.json").read_text("ascii"))


def _bytes(text: str) -> bytes:
    return base64.b64decode(text)


def _event(vector: dict[str, Any]) -> LoggableEvent:
    return LoggableEvent(vector["timestamp_us"], vector["event_id"], _bytes(vector["data"]))


def _block(vector: dict[str, Any]) -> Block:
    return Block(vector["agent_id"], vector["timestamp_us"], _bytes(vector["event_data"]))


def _field(value: Any) -> Any:
    """Return the value of a message's field: a block, a hash, a number or a flag."""
    if isinstance(value, dict):
        return _block(value)
    return bytes.fromhex(value) if isinstance(value, str) else value
