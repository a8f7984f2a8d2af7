"""Test the Wireshark dissector with tshark: it shows each declared field, and rejects the same datagrams as the
codec.
"""

import json
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

import pytest
from scapy.layers.inet import IP, UDP
from scapy.layers.l2 import Ether
from scapy.packet import Raw
from scapy.utils import RawPcapWriter

from tests.machine import require_tshark
from tests.ucp.secure.swarm import session
from ucp.block import BLOCK_FIELDS, Block
from ucp.contract.wireshark import DISSECTOR
from ucp.events import EVENT_FIELDS, LoggableEvent, decode_events
from ucp.messages import (
    HEADER,
    HEADER_FIELDS,
    PORT,
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    MalformedDatagramError,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
    decode,
    encode,
)
from ucp.secure.envelope import CLEAR, CLEAR_FIELDS, read_clear_header
from ucp.secure.revocation import Revocation

TIMEOUT_S = 120.0
A, B = bytes(range(32)), bytes(range(200, 232))
EVENTS = [LoggableEvent(2**64 - 1, 254, b"old"), LoggableEvent(7, 1, bytes(256)), LoggableEvent(0, 9, b"")]
LOGGED = Block(65535, 2**64 - 1, b"".join(event.encode() for event in EVENTS))
MESSAGES: list[Message] = [
    BlockAddRequest(A, B),
    BlockAddResponse(A, True),
    BlockAddResponse(A, False, B),
    CommitBlock(LOGGED, A),
    ChainContainQuery(A),
    ChainContainResponse(A, True),
    ChainContainResponse(A, False),
    ChainHashSuccessorQuery(A),
    NextInSequenceResponse(A, None, 0),
    NextInSequenceResponse(A, B, 2**64 - 1),
    RequestForBlock(A),
    BlockResponse(LOGGED),
]
DATAGRAMS = [encode(65535 - place, 2**32 - 1 - place, message) for place, message in enumerate(MESSAGES)]


def frame(datagram: bytes) -> bytes:
    link = Ether(src="02:00:00:00:00:01", dst="ff:ff:ff:ff:ff:ff") / IP(src="10.77.0.1", dst="10.77.255.255")
    return bytes(link / UDP(sport=PORT, dport=PORT) / Raw(datagram))


def tshark(folder: Path, frames: Sequence[bytes], *options: str, captured: int | None = None) -> str:
    """Return the output of tshark for these frames. `captured` is the number of captured bytes of each frame (None for
    all).
    """
    program = require_tshark()
    capture = folder / "air.pcap"
    with RawPcapWriter(str(capture), linktype=1) as writer:
        writer.write_header(None)
        for sent in frames:
            writer.write_packet(sent[:captured], wirelen=len(sent))
    command = [program, "-r", str(capture), "-X", f"lua_script:{DISSECTOR}", *options]
    ran = subprocess.run(
        command, env={**os.environ, "HOME": str(folder)}, capture_output=True, text=True, timeout=TIMEOUT_S, check=True
    )
    assert "Lua" not in ran.stderr
    assert "Lua Error" not in ran.stdout
    return ran.stdout


def layers(folder: Path, datagrams: Sequence[bytes], captured: int | None = None) -> list[dict[str, Any]]:
    """Return the dissector's tree for each datagram. Only `captured` bytes of each frame are captured."""
    options = ("-T", "json", "-J", "ucpchain", "--no-duplicate-keys")
    packets = json.loads(tshark(folder, [frame(datagram) for datagram in datagrams], *options, captured=captured))
    return [packet["_source"]["layers"]["ucpchain"] for packet in packets]


def experts(tree: Any) -> dict[str, str]:
    """Return the name and message of all expert information in a tree."""
    if isinstance(tree, list):
        return {name: message for part in tree for name, message in experts(part).items()}
    if not isinstance(tree, dict):
        return {}
    own = {name: tree["_ws.expert.message"] for name in tree if "_ws.expert.message" in tree and not tree[name]}
    return own | experts(list(tree.values()))


def shown(prefix: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return values in the form in which tshark shows them. Fields that tshark does not show are left out."""
    text: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Block):
            text[f"{prefix}.{name}"] = shown_block(value)
        elif isinstance(value, bytes) and value:
            text[f"{prefix}.{name}"] = value.decode() if name == "magic" else value.hex(":")
        elif isinstance(value, int):
            text[f"{prefix}.{name}"] = str(int(value))
    return text


def shown_block(block: Block) -> dict[str, Any]:
    return {
        **shown("ucpchain.block", {name: getattr(block, name) for name in BLOCK_FIELDS}),
        "ucpchain.event": [
            shown("ucpchain.event", {name: getattr(event, name, len(event.data)) for name in [*EVENT_FIELDS, "data"]})
            for event in decode_events(block.event_data)
        ],
    }


def test_every_field_of_every_message_is_shown(tmp_path: Path) -> None:
    assert {type(message) for message in MESSAGES} == set(Message.__args__)
    for message, datagram, layer in zip(MESSAGES, DATAGRAMS, layers(tmp_path, DATAGRAMS), strict=True):
        header = dict(zip(HEADER_FIELDS, HEADER.unpack_from(datagram), strict=True))
        expected = shown("ucpchain", header | {name: getattr(message, name) for name in message.WIRE})
        if message == NextInSequenceResponse(A, None, 0):
            expected["ucpchain.is_top_of_chain"] = "1"
        assert layer == expected
        assert list(layer) == list(expected), "in the order in which they are sent"


def test_packet_list_names_message_and_sender(tmp_path: Path) -> None:
    lines = tshark(tmp_path, [frame(datagram) for datagram in DATAGRAMS]).splitlines()
    for place, (message, line) in enumerate(zip(MESSAGES, lines, strict=True)):
        assert " UCP " in line
        assert line.endswith(f"{message.NAME} from {65535 - place}")


def test_dissector_shows_the_clear_fields_of_secured_datagrams(tmp_path: Path) -> None:
    body = Revocation(3, frozenset((2, 9)), bytes(range(64))).encode()
    sealed, revokes = session(2).seal(7, CommitBlock(LOGGED, A), None, None, 1), session(1).seal_revocation(body, 3)
    for datagram, layer in zip((sealed, revokes), layers(tmp_path, (sealed, revokes)), strict=True):
        header = shown("ucpchain", dict(zip(CLEAR_FIELDS, CLEAR.unpack_from(datagram), strict=True)))
        assert {name: layer[name] for name in header} == header
        assert experts(layer) == {}
        assert [layer[f"ucpchain.{name}"].replace(":", "") for name in ("ciphertext", "tag")] == [
            part.hex() for part in (datagram[CLEAR.size : -16], datagram[-16:])
        ]
    short = revokes[: CLEAR.size - 24] + (15).to_bytes(2, "big") + revokes[14 : CLEAR.size] + bytes(15)
    assert experts(layers(tmp_path, [short])[0]) == {"ucpchain.malformed": "wrong length"}
    assert "Commit Block from 2, secured" in tshark(tmp_path, [frame(sealed)])
    for captured in (50, 70, 100):
        assert set(experts(layers(tmp_path, [sealed], captured)[0])) == {"ucpchain.cut_off"}


def damaged(rng: Random) -> bytes:
    datagram = bytearray(rng.choice(DATAGRAMS))
    for _ in range(rng.randrange(3)):
        place = rng.randrange(rng.choice((19, len(datagram))))
        datagram[place] = rng.choice((rng.randrange(12), rng.randrange(256)))
    if rng.random() < 0.5:
        return bytes(datagram)
    kept = datagram[: rng.randint(1, len(datagram))] + rng.randbytes(rng.choice((0, 1, 32, 1100, 1472)))
    if rng.random() < 0.8 and len(kept) >= HEADER.size:
        kept[HEADER.size - 2 : HEADER.size] = (len(kept) - HEADER.size).to_bytes(2, "big")
    return bytes(kept)


def test_dissector_gives_the_same_reasons_as_the_codec(tmp_path: Path) -> None:
    rng = Random(7)
    datagrams = [damaged(rng) for _ in range(3000)] + [rng.randbytes(rng.randint(1, 100)) for _ in range(200)]
    reasons = set()
    for datagram, layer in zip(datagrams, layers(tmp_path, datagrams), strict=True):
        reason = None
        try:
            read_clear_header(datagram) if datagram[:3] == b"UC\3" else decode(datagram)
        except MalformedDatagramError as malformed:
            reason = malformed.reason
        assert experts(layer).get("ucpchain.malformed") == reason, datagram.hex()
        reasons.add(reason)
    assert len(reasons) == 10, "each of the codec's reasons, and none"


def test_malformed_event_data_is_a_warning(tmp_path: Path) -> None:
    event = EVENTS[0].encode()
    wrong = {
        "the event's header is cut off": event[:10],
        "the event claims 3 bytes, more than are left": event[:-1],
        "the event has ID 0, not in 1..254": event[:8] + b"\0" + event[9:],
    }
    trees = layers(tmp_path, [encode(1, 0, BlockResponse(Block(1, 2, event + second))) for second in wrong.values()])
    for tree, what in zip(trees, wrong, strict=True):
        assert experts(tree) == {"ucpchain.event.malformed": f"At byte {HEADER.size + 12 + len(event)} {what}"}
        assert tree["ucpchain.block"]["ucpchain.event"]["ucpchain.event.data"] == EVENTS[0].data.hex(":")


@pytest.mark.parametrize("captured", [43, 55, 56, 70, 100])
def test_truncated_capture_is_not_called_malformed(tmp_path: Path, captured: int) -> None:
    for datagram, tree in zip(DATAGRAMS, layers(tmp_path, DATAGRAMS, captured), strict=True):
        assert set(experts(tree)) == ({"ucpchain.cut_off"} if captured < len(frame(datagram)) else set())


def test_empty_datagram_causes_no_error(tmp_path: Path) -> None:
    assert len(tshark(tmp_path, [frame(b"")], "-V").splitlines()) > 1
    assert len(tshark(tmp_path, [frame(DATAGRAMS[0])], "-V", captured=42).splitlines()) > 1
