"""Encode and decode the messages between a stand-in and the far end.

Each message has its own authentication tag (HMAC-SHA256, 16 bytes). The tag covers the number of the message in its
direction, so a message that is changed, repeated, left out or moved ends the connection. The messages are not
encrypted. Both directions have their own key, which is valid for one connection.
"""

from __future__ import annotations

import hmac
import json
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

from ucp.plain_file import parse_json

TAG_BYTES = 16
MAX_MESSAGE_BYTES = 8 << 20
"""Maximum size of a message. The largest are a mission file and a chain export."""
_HEADER = struct.Struct("!IB")
_NUMBER = struct.Struct("!Q")


class WireError(Exception):
    """An error: the other end sent data that are not authentic, or not a message. The text is one sentence."""


class Kind(IntEnum):
    """The kinds of messages. `begin`, `resume`, `idle`, `request` and `signal` go to the far end, and `ping` too."""

    PING = 1
    PONG = 2
    DATAGRAM = 3
    BEGIN = 4
    RESUME = 5
    IDLE = 6
    REQUEST = 7
    ANSWER = 8
    SIGNAL = 9
    READY = 10
    TRACE = 11
    LOG = 12
    EXPORT = 13
    STORE = 14
    LAG = 15
    EXIT = 16


@dataclass(frozen=True)
class Message:
    """A message that has been checked."""

    kind: Kind
    payload: bytes

    def document(self) -> dict[str, Any]:
        """Return the JSON object in the message. Raises WireError."""
        try:
            value = parse_json(self.payload)
        except ValueError:
            value = None
        if not isinstance(value, dict):
            raise WireError(f"a message {self.kind.name} is not a JSON object")
        return value


class Channel:
    """The state of one connection: keys, numbers of messages, and bytes of an incomplete message."""

    def __init__(self, send_key: bytes, receive_key: bytes, sent: int = 0, received: int = 0) -> None:
        self._send_key, self._receive_key = send_key, receive_key
        self._sent, self._received = sent, received
        self._unread = bytearray()

    def encode(self, kind: Kind, payload: bytes = b"") -> bytes:
        """Return the bytes of the next message."""
        tag = _tag(self._send_key, self._sent, kind, payload)
        self._sent += 1
        return _HEADER.pack(len(payload), kind) + payload + tag

    def encode_json(self, kind: Kind, document: dict[str, Any]) -> bytes:
        return self.encode(kind, json.dumps(document).encode())

    def decode(self, data: bytes) -> list[Message]:
        """Return the messages that these bytes complete. Raises WireError."""
        self._unread += data
        messages = []
        while len(self._unread) >= _HEADER.size:
            length, number = _HEADER.unpack_from(self._unread)
            if length > MAX_MESSAGE_BYTES:
                raise WireError(f"a message has {length} bytes, and at most {MAX_MESSAGE_BYTES} are allowed")
            end = _HEADER.size + length + TAG_BYTES
            if len(self._unread) < end:
                break
            payload = bytes(self._unread[_HEADER.size : _HEADER.size + length])
            tag = bytes(self._unread[end - TAG_BYTES : end])
            if not hmac.compare_digest(tag, _tag(self._receive_key, self._received, number, payload)):
                raise WireError("a message is not authentic")
            self._received += 1
            del self._unread[:end]
            try:
                messages.append(Message(Kind(number), payload))
            except ValueError:
                raise WireError(f"a message has the unknown kind {number}") from None
        return messages

    def to_json(self) -> dict[str, Any]:
        """Return the state of the channel, so that another process can continue with it. No message may be
        incomplete.
        """
        assert not self._unread, "a message is incomplete"
        return {
            "send_key": self._send_key.hex(),
            "receive_key": self._receive_key.hex(),
            "sent": self._sent,
            "received": self._received,
        }

    @classmethod
    def from_json(cls, state: dict[str, Any]) -> Channel:
        keys = bytes.fromhex(state["send_key"]), bytes.fromhex(state["receive_key"])
        return cls(*keys, state["sent"], state["received"])


def _tag(key: bytes, number: int, kind: int, payload: bytes) -> bytes:
    return hmac.digest(key, _NUMBER.pack(number) + bytes([kind]) + payload, "sha256")[:TAG_BYTES]


ADDRESS_BYTES = 4
"""Number of bytes of the sender's address before a datagram to the agent."""
NUMBER_BYTES = 4
"""Number of bytes of the number before a request and its answer."""
SILENT_S = 2.0
"""Wall seconds without a ping or pong after which a vehicle counts as cut off."""
LOST_AFTER_S = 10.0
"""Wall seconds without an acknowledgement after which the kernel gives up a connection."""


def prepare(connection: socket.socket) -> None:
    """Let the kernel send without delay, and give up a dead connection after `LOST_AFTER_S`."""
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(LOST_AFTER_S * 1000))
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in ((socket.TCP_KEEPIDLE, 4), (socket.TCP_KEEPINTVL, 2), (socket.TCP_KEEPCNT, 3)):
        connection.setsockopt(socket.IPPROTO_TCP, option, value)


HANDED_OVER_BYTES = 4096


def bind_path(outside: socket.socket, path: Path) -> None:
    """Bind a Unix socket to a path of any length. Raises OSError."""
    with short_name(path.parent) as directory:
        outside.bind(f"{directory}/{path.name}")


def connect_path(inside: socket.socket, path: Path) -> None:
    """Connect a Unix socket to a path of any length. Raises OSError."""
    with short_name(path.parent) as directory:
        inside.connect(f"{directory}/{path.name}")


@contextmanager
def short_name(path: Path) -> Iterator[str]:
    """Provide a short name of a directory, because the address of a socket has at most 107 bytes."""
    descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{descriptor}"
    finally:
        os.close(descriptor)


def hand_over(inside: socket.socket, connection: socket.socket, state: dict[str, Any]) -> None:
    """Send a connected socket and the state of its channel to the process inside the private network, and close the
    socket. Raises OSError.
    """
    with connection:
        socket.send_fds(inside, [json.dumps(state).encode()], [connection.fileno()])


def take_over(outside: socket.socket) -> tuple[socket.socket, dict[str, Any]] | None:
    """Return a connected socket and its state, which the process outside has sent. Return None if that process has
    ended. Raises BlockingIOError if no socket has arrived.
    """
    data, descriptors, _, _ = socket.recv_fds(outside, HANDED_OVER_BYTES, 1)
    if not data:
        return None
    connection = socket.socket(fileno=descriptors[0])
    connection.setblocking(False)
    state: dict[str, Any] = json.loads(data)
    return connection, state
