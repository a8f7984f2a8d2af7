"""Fuzz target: a computer that joins a lab, and a harness that welcomes it. The first byte of the input selects the
reader.
"""

import asyncio
import json
import socket
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, cast

from harness.archive.directory import RunDirectory
from harness.play.remote._far_clock import FarClock, ping, pong
from harness.play.remote._far_ends import FarEnds
from harness.play.remote._handshake import PROTOCOL, HandshakeError, Hello, RefusedError, introduce, receive_hello
from harness.play.remote._key_exchange import KeyExchange
from harness.play.remote._remote_agents import RemoteAgents
from harness.play.remote._wire import Channel, Kind, WireError
from harness.scenario.load import parse
from tests.fuzz.finding import require
from ucp.features import CONTRACT
from ucp.plain_file import parse_json

SECRET = bytes(32)


def run(data: bytes) -> None:
    readers = (_far_end, _harness, _hello, _messages, _raw)
    readers[data[0] % len(readers) if data else 0](data[1:])


def _far_end(data: bytes) -> None:
    """Give the harness a hello of an attacker without the secret."""
    _refused(data, lambda connection: receive_hello(connection, SECRET))


def _harness(data: bytes) -> None:
    """Give the far end a welcome of an attacker who imitates the harness without the secret."""
    _refused(data, lambda connection: introduce(connection, SECRET, {"agent": 2}))


def _refused(data: bytes, read: Callable[[socket.socket], Awaitable[object]]) -> None:
    async def converse() -> None:
        near, far = socket.socketpair()
        with near, far:
            for end in (near, far):
                end.setblocking(False)
            with suppress(BlockingIOError):
                far.send(data)
            far.shutdown(socket.SHUT_WR)
            with suppress(HandshakeError, RefusedError, OSError):
                await read(near)
                require(False, "it accepts a connection without the secret")

    asyncio.run(converse())


def _hello(data: bytes) -> None:
    """Give the harness a request for a vehicle from a far end with the secret."""
    try:
        words = parse_json(data)
    except ValueError:
        return
    if not isinstance(words, dict):
        return
    with socket.socket() as connection:
        hello = Hello(words, connection, SECRET, b"", b"", KeyExchange(), None)
        refused = FarEnds(_agents(), "join").refusal(hello, "192.168.7.2")
    require("\n" not in refused and len(refused) < 500, "an error that is no sentence")
    require(bool(refused) or words["agent"] == 2, "another vehicle")


def _messages(data: bytes) -> None:
    """Give a receiver authentic messages. It receives them or refuses their kind."""
    sender, receiver = Channel(b"a", b"b"), Channel(b"b", b"a")
    clock = FarClock()
    for part in data.split(b"\n"):
        kind, payload = part[:1] or b"\0", part[1:]
        with suppress(WireError):
            (message,) = receiver.decode(sender.encode(kind[0], payload))  # type: ignore[arg-type]
            require(message.payload == payload, "another message arrives")
            require(isinstance(message.document(), dict), "not an object")
        with suppress(WireError):
            pong(payload, 0)
        with suppress(WireError):
            clock.receive(payload)


def _raw(data: bytes) -> None:
    """Give a receiver bytes from a sender without the keys."""
    with suppress(WireError):
        require(Channel(b"a", b"b").decode(data) == [], "it accepts a message without a tag")


@cache
def _agents() -> RemoteAgents:
    remote = {"agents": [2], "secret_file": "none"}
    scenario = parse({"name": "join", "agents": 3, "vehicles": {"kind": "none"}, "remote": remote})
    return RemoteAgents(scenario, cast("RunDirectory", None), lambda: 0.0)  # greetings need no files


def seeds(flown: Path) -> Iterator[bytes]:
    hello: dict[str, Any] = {"protocol": PROTOCOL, "contract": CONTRACT, "agent": 2, "session": "1", "command": ["a"]}
    text = json.dumps(hello).encode()
    yield b"\0" + len(text).to_bytes(2, "big") + text + bytes(64)
    yield b"\1UCPJOIN1" + bytes(32) + b"\0\2{}" + bytes(32)
    yield b"\2" + text
    yield b"\2" + json.dumps({**hello, "agent": 9}).encode()
    yield b"\3" + bytes([Kind.EXIT]) + b'{"status": 0, "left_behind": []}\n' + bytes([Kind.PONG]) + bytes(32)
    yield b"\3" + bytes([Kind.PING]) + ping()
    yield b"\4" + Channel(b"c", b"a").encode(Kind.IDLE)
