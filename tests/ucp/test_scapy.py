"""Test that the scapy layers and the codec implement the same format. Both read the same datagrams and reject the same
bytes.
"""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.config import conf
from scapy.layers.inet import IP, UDP
from scapy.layers.l2 import Ether
from scapy.packet import NoPayload, Packet, Raw, ls
from scapy.utils import rdpcap, wrpcap

import ucp.block
import ucp.messages
from tests.ucp.datagrams import all_messages, damaged, event_runs
from tests.ucp.test_messages import senders, sequences
from ucp.events import MalformedEventsError, decode_events
from ucp.messages import HEADER, HEADER_FIELDS, MalformedDatagramError, Message, decode, encode
from ucp.scapy import (
    LAYERS,
    UCP,
    Block,
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    CommitBlock,
    LoggableEvent,
    NextInSequenceResponse,
    RequestForBlock,
    SecuredUCP,
    message_of,
    to_layer,
)


@pytest.fixture(autouse=True, scope="module")
def _scapy_raises_what_it_would_hide() -> Iterator[None]:
    conf.debug_dissector, before = True, conf.debug_dissector
    yield
    conf.debug_dissector = before


def crafted_block(block: ucp.block.Block) -> Packet:
    return Block(agent_id=block.agent_id, timestamp_us=block.timestamp_us, events=crafted_events(block.event_data))


def crafted_events(event_data: bytes) -> list[Packet]:
    try:
        events = decode_events(event_data)
    except MalformedEventsError:
        return [Raw(event_data)]
    return [LoggableEvent(timestamp_us=e.timestamp_us, event_id=e.event_id, data=e.data) for e in events]


def crafted(message: Message) -> Packet:
    """Return a message as a scapy layer. The layer is created from the fields of the message by their names."""
    fields: dict[str, Any] = {name: getattr(message, name) for name in message.WIRE}
    if "block" in fields:
        fields["block"] = crafted_block(fields["block"])
    return LAYERS[type(message)](**fields)


@given(senders, sequences, all_messages)
def test_scapy_reads_each_field_that_the_codec_writes(sender: int, sequence: int, message: Message) -> None:
    datagram = encode(sender, sequence, message)
    packet = UCP(datagram)
    header = [packet.getfieldval(name) for name in HEADER_FIELDS]
    assert header == list(HEADER.unpack_from(datagram))
    assert type(packet.payload) is LAYERS[type(message)]
    assert [field.name for field in packet.payload.fields_desc] == list(message.WIRE)
    for name in message.WIRE:
        read, written = getattr(packet.payload, name), getattr(message, name)
        if isinstance(written, ucp.block.Block):
            assert (read.agent_id, read.timestamp_us) == (written.agent_id, written.timestamp_us)
            assert b"".join(bytes(event) for event in read.events) == written.event_data
            assert read.block_hash == written.block_hash
        else:
            assert read == written
    assert isinstance(packet.lastlayer().payload, NoPayload)
    assert message_of(packet) == (sender, sequence, message)


@given(senders, sequences, all_messages)
def test_scapy_crafts_the_datagram_of_the_codec(sender: int, sequence: int, message: Message) -> None:
    datagram = encode(sender, sequence, message)
    assert bytes(UCP(sender=sender, sequence=sequence) / crafted(message)) == datagram
    assert bytes(UCP(sender=sender, sequence=sequence) / to_layer(message)) == datagram


@given(damaged() | st.binary(min_size=1, max_size=1600))
def test_scapy_finds_a_message_if_and_only_if_the_codec_does(datagram: bytes) -> None:
    packet = UCP(datagram)
    assert bytes(packet) == datagram
    try:
        _, _, message = decode(datagram)
    except MalformedDatagramError:
        assert type(packet.lastlayer()) in (Raw, UCP, SecuredUCP)
    else:
        assert type(packet.lastlayer()) is LAYERS[type(message)]


@given(event_runs, st.binary(max_size=40), st.integers(0, 1024))
def test_scapy_reads_events_up_to_the_first_malformed_one(run: bytes, noise: bytes, place: int) -> None:
    event_data = run[:place] + noise + run[place + len(noise) :]
    events = Block(ucp.block.Block(1, 2, event_data).block_data()).events
    assert b"".join(bytes(event) for event in events) == event_data
    assert all(isinstance(event, LoggableEvent) for event in events[:-1])
    try:
        expected = decode_events(event_data)
    except MalformedEventsError:
        assert isinstance(events[-1], Raw)
    else:
        assert [(e.timestamp_us, e.event_id, e.data) for e in events] == [
            (e.timestamp_us, e.event_id, e.data) for e in expected
        ]


def test_capture_shows_messages_and_computes_omitted_fields(tmp_path: Path) -> None:
    air = Ether(src="02:00:00:00:00:01", dst="ff:ff:ff:ff:ff:ff") / IP(src="10.77.0.1", dst="10.77.255.255") / UDP()
    events = [LoggableEvent(timestamp_us=5, event_id=1, data=b"old"), LoggableEvent(timestamp_us=9, event_id=2)]
    block = Block(agent_id=1, events=events)
    request = air / UCP(sender=1, sequence=7) / BlockAddRequest(block_hash=block.block_hash, chain_hash=b"\1" * 32)
    commit = air / UCP(sender=1, sequence=8) / CommitBlock(chain_hash=b"\2" * 32, block=block)
    foreign = air / UDP(dport=9) / Raw(b"UC")
    wrpcap(str(tmp_path / "air.pcap"), [request, commit, foreign])

    read = rdpcap(str(tmp_path / "air.pcap"))
    assert "Block Add Request" in read[0].summary()
    assert (read[0][UDP].sport, read[0][UDP].dport) == (14600, 14600)
    assert (read[0][UCP].type, read[0][UCP].length) == (1, 64)
    assert read[0][BlockAddRequest].block_hash == read[1][Block].block_hash
    assert (read[1][Block].timestamp_us, read[1][LoggableEvent].length) == (9, 3)
    assert message_of(read[1])[2] == ucp.messages.CommitBlock(
        ucp.block.Block(1, 9, b"".join(bytes(event) for event in events)), b"\2" * 32
    )
    with pytest.raises(MalformedDatagramError, match="no UCP"):
        message_of(read[2])


def test_padding_of_a_frame_is_no_part_of_the_message() -> None:
    link = Ether(dst="ff:ff:ff:ff:ff:ff") / IP(src="10.77.0.1", dst="10.79.255.255")
    frame = bytes(link / UDP() / UCP() / RequestForBlock())
    assert message_of(Ether(frame + b"\xde\xad\xbe\xef"))[2] == ucp.messages.RequestForBlock(bytes(32))


def test_scapy_crafts_invalid_fields() -> None:
    assert message_of(UCP() / BlockAddResponse(approve=1))[2] == ucp.messages.BlockAddResponse(bytes(32), True)
    top = message_of(UCP() / NextInSequenceResponse(timestamp_us=3))[2]
    assert top == ucp.messages.NextInSequenceResponse(bytes(32), None, 3)
    lies: dict[str, Packet] = {
        "wrong version": UCP(version=9) / RequestForBlock(),
        "impossible sender": UCP(sender=0) / RequestForBlock(),
        "wrong length": UCP(length=3) / RequestForBlock(),
        "unknown type": UCP(type=77) / RequestForBlock(),
        "bad vote": UCP() / BlockAddResponse(approve=2),
        "impossible agent": UCP() / BlockResponse(block=Block(agent_id=70000, events=[Raw(b"x")])),
    }
    for reason, packet in lies.items():
        with pytest.raises(MalformedDatagramError, match=reason):
            message_of(packet)


@pytest.mark.parametrize("message", LAYERS)
def test_ls_shows_each_message_with_its_name_in_the_thesis(message: Any, capsys: pytest.CaptureFixture[str]) -> None:
    ls(LAYERS[message])
    documented = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert documented == list(message.WIRE)
    assert LAYERS[message].__name__ == message.__name__
    assert LAYERS[message]().name == message.NAME


def test_agent_starts_without_scapy() -> None:
    program = "import sys, ucp.node; sys.exit('scapy' in sys.modules)"
    subprocess.run([sys.executable, "-P", "-c", program], check=True)
