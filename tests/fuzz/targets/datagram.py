"""Fuzz target: a received datagram. If the decoder accepts the datagram, the encoder reproduces the same bytes."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from harness.archive.packets.capture_reader import NotUcpError, summarize, unwrap
from harness.archive.packets.pcap import CaptureFile
from tests.fuzz.finding import require
from ucp.events import MalformedEventsError, decode_events
from ucp.messages import MAX_DATAGRAM_BYTES, MalformedDatagramError, datagram_bytes, decode
from ucp.secure.envelope import CLEAR, read_clear_header
from ucp.telemetry import describe


def run(data: bytes) -> None:
    with suppress(MalformedDatagramError):
        clear = read_clear_header(data)
        require(clear.pack(len(data) - CLEAR.size) == data[: CLEAR.size], "a clear header is written otherwise")
    try:
        datagram = decode(data)
    except MalformedDatagramError:
        return
    require(datagram.encode() == data and len(data) <= MAX_DATAGRAM_BYTES, "accepted, and written otherwise")
    require(datagram_bytes(datagram.message) == len(data), "its length is not what it is said to be")
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
