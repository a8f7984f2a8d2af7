"""Fuzz target: a received datagram. If it is accepted, the encoder reproduces it, and scapy reads the same content."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scapy.config import conf
from scapy.packet import Raw

from harness.archive.packets.datagram import NotUcpError, summarize, unwrap
from harness.archive.packets.pcap import CaptureFile
from tests.fuzz.finding import require
from ucp.events import MalformedEventsError, decode_events
from ucp.messages import MAX_DATAGRAM_BYTES, MalformedDatagramError, datagram_bytes, decode
from ucp.scapy import LAYERS, UCP, SecuredUCP
from ucp.telemetry import describe


def run(data: bytes) -> None:
    with _scapy_raises():
        _run(data)


@contextmanager
def _scapy_raises() -> Iterator[None]:
    """Let scapy raise the errors of its layers, which it normally hides."""
    conf.debug_dissector, before = True, conf.debug_dissector
    try:
        yield
    finally:
        conf.debug_dissector = before


def _run(data: bytes) -> None:
    packet = UCP(data) if data else None
    require(packet is None or bytes(packet) == data, "scapy gives other bytes back")
    try:
        datagram = decode(data)
    except MalformedDatagramError:
        sealed = isinstance(packet, SecuredUCP)  # of a secured mission: this codec reads plain datagrams only
        accepted = packet is not None and not sealed and type(packet.lastlayer()) not in (Raw, UCP)
        require(not accepted, "scapy accepts what the codec refuses")
        return
    require(datagram.encode() == data and len(data) <= MAX_DATAGRAM_BYTES, "accepted, and written otherwise")
    require(datagram_bytes(datagram.message) == len(data), "its length is not what it is said to be")
    assert packet is not None
    require(type(packet.lastlayer()) is LAYERS[type(datagram.message)], "scapy reads another message")
    summarize(datagram.message)
    block = getattr(datagram.message, "block", None)
    if block is None:
        return
    try:
        events = decode_events(block.event_data)
    except MalformedEventsError:
        return
    require(b"".join(event.encode() for event in events) == block.event_data, "events are written otherwise")
    for event in events:
        describe(event.event_id, event.data)


def seeds(flown: Path) -> Iterator[bytes]:
    """Yield a datagram of each type."""
    types: dict[int, bytes] = {}
    for capture in sorted((flown / "capture").iterdir()):
        for frame in CaptureFile(capture):
            try:
                datagram, _ = unwrap(frame)
            except NotUcpError:
                continue
            types.setdefault(datagram[3], datagram)
    yield from types.values()
