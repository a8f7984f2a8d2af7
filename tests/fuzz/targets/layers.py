"""Fuzz target: scapy's layers of a datagram. They reproduce its bytes, and accept the same datagrams as the codec."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scapy.config import conf
from scapy.packet import Raw

from tests.fuzz.finding import require
from tests.fuzz.targets import datagram
from ucp.messages import MalformedDatagramError, decode
from ucp.scapy import LAYERS, UCP, SecuredUCP


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
        message = decode(data).message
    except MalformedDatagramError:
        sealed = isinstance(packet, SecuredUCP)  # of a secured mission: this codec reads plain datagrams only
        accepted = packet is not None and not sealed and type(packet.lastlayer()) not in (Raw, UCP)
        require(not accepted, "scapy accepts what the codec refuses")
        return
    assert packet is not None
    require(type(packet.lastlayer()) is LAYERS[type(message)], "scapy reads another message")


def seeds(flown: Path) -> Iterator[bytes]:
    return datagram.seeds(flown)
