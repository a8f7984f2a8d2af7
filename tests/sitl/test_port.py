"""Test the limits of the TCP port. All code runs in one process, and only the client empties the buffer."""

from __future__ import annotations

import selectors
import socket
import time
from collections.abc import Iterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from sitl._autopilot import Autopilot
from sitl._port import MAX_UNSENT_BYTES, VehiclePort
from sitl.streams import heartbeat
from tests.sitl.flying import DEADLINE_S, HOME, free_ports


def turn(selector: selectors.BaseSelector, timeout_s: float = 0.0) -> None:
    for key, events in selector.select(timeout_s):
        key.data(events)


@pytest.fixture
def connected() -> Iterator[tuple[VehiclePort, selectors.BaseSelector, socket.socket]]:
    (number,) = free_ports(1)
    with selectors.DefaultSelector() as selector, socket.socket() as client:
        port = VehiclePort(number, Autopilot(3, HOME, 0), selector)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", number))
        turn(selector, DEADLINE_S)
        assert port.channel is not None
        yield port, selector, client


def test_client_that_reads_late_gets_complete_messages(
    connected: tuple[VehiclePort, selectors.BaseSelector, socket.socket],
) -> None:
    port, selector, client = connected
    assert port.channel is not None
    most, unsent_since = 0, None
    deadline = time.monotonic() + DEADLINE_S
    while unsent_since is None or unsent_since < 1000:  # the kernel's own buffers fill first
        assert time.monotonic() < deadline
        for _ in range(200):
            port.channel.send(heartbeat(port.channel._autopilot))
        port.send()
        turn(selector)
        most = max(most, len(port._unsent))
        unsent_since = (unsent_since or 0) + 1 if port._unsent else None
    assert 0 < most <= MAX_UNSENT_BYTES

    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    client.settimeout(DEADLINE_S)
    received: list[Any] = []
    while port._unsent:
        received += parser.parse_buffer(client.recv(65536)) or ()
        turn(selector)
    assert {message.get_type() for message in received} == {"HEARTBEAT"}
    assert parser.total_receive_errors == 0


def test_unsent_bytes_end_with_their_client(
    connected: tuple[VehiclePort, selectors.BaseSelector, socket.socket],
) -> None:
    port, selector, client = connected
    client.close()
    turn(selector, DEADLINE_S)
    assert port.channel is None
    assert not port._unsent
    port.send()  # without a client
