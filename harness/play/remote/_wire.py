"""Encode and decode the messages between a stand-in and the far end.

Each message has its own authentication tag of 16 bytes. The tag covers the number of the message in its direction, so a
message that is changed, repeated, left out or moved ends the connection. Both directions have their own key, which is
valid for one connection.

If both ends have the package cryptography, messages are encrypted with ChaCha20-Poly1305 (RFC 8439), whose nonce is the
number of the message. Without this package, messages are in the clear, and their tag is an HMAC-SHA256. The keys of a
mission travel only encrypted.
"""

from __future__ import annotations

import hmac
import json
import socket
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from ucp.plain_file import parse_json

TAG_BYTES = 16
MAX_MESSAGE_BYTES = 8 << 20
"""Maximum size of a message in bytes. The largest messages are mission files and chain exports."""
_HEADER = struct.Struct("!IB")
_NUMBER = struct.Struct("!Q")


class WireError(Exception):
    """An error: the other end sent data that are not authentic, or not a message. The text is one sentence."""


class Kind(IntEnum):
    """The kinds of messages. The harness sends the kinds `begin`, `resume`, `idle`, `request`, `signal` and `ping` to
    the far end. Only the connections of workers (`harness.play.hosts`) use `stream` and `file`.
    """

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
    BUNDLE = 17
    STREAM = 18
    FILE = 19


@dataclass(frozen=True)
class Message:
    """A message that has been checked."""

    kind: Kind
    payload: bytes

    def document(self, **types: type) -> dict[str, Any]:
        """Return the JSON object in the message. `types` maps keys that the object must have to the types of their
        values. Raises WireError.
        """
        try:
            value = parse_json(self.payload)
        except ValueError:
            value = None
        if not isinstance(value, dict):
            raise WireError(f"a message {self.kind.name} is not a JSON object")
        for key, expected in types.items():
            if not isinstance(value.get(key), expected):
                raise WireError(f"a message {self.kind.name} has no {key!r} of the type {expected.__name__}")
        return value


class Channel:
    """The state of one connection: keys, numbers of messages, and bytes of an incomplete message."""

    def __init__(
        self, send_key: bytes, receive_key: bytes, sent: int = 0, received: int = 0, *, is_encrypted: bool = False
    ) -> None:
        self._keys = send_key, receive_key
        self.is_encrypted = is_encrypted
        protection: type[_Encryption | _Authentication] = _Encryption if is_encrypted else _Authentication
        self._sender, self._receiver = protection(send_key), protection(receive_key)
        self._sent, self._received = sent, received
        self._unread = bytearray()

    def encode(self, kind: Kind, payload: bytes = b"") -> bytes:
        """Return the bytes of the next message."""
        header = _HEADER.pack(len(payload), kind)
        body = self._sender.protect(self._sent, header, payload)
        self._sent += 1
        return header + body

    def encode_json(self, kind: Kind, document: dict[str, Any]) -> bytes:
        return self.encode(kind, json.dumps(document).encode())

    def decode(self, data: bytes) -> list[Message]:
        """Add received bytes to the buffer. Return the messages that are complete now. Raises WireError."""
        self._unread += data
        messages = []
        while len(self._unread) >= _HEADER.size:
            length, number = _HEADER.unpack_from(self._unread)
            if length > MAX_MESSAGE_BYTES:
                raise WireError(f"a message has {length} bytes, and at most {MAX_MESSAGE_BYTES} are allowed")
            end = _HEADER.size + length + TAG_BYTES
            if len(self._unread) < end:
                break
            header, body = bytes(self._unread[: _HEADER.size]), bytes(self._unread[_HEADER.size : end])
            payload = self._receiver.open(self._received, header, body)
            self._received += 1
            del self._unread[:end]
            try:
                messages.append(Message(Kind(number), payload))
            except ValueError:
                raise WireError(f"a message has the unknown kind {number}") from None
        return messages

    def to_json(self) -> dict[str, Any]:
        """Return the state of the channel, so that another process can continue to use the connection. The caller must
        have read the last message completely.
        """
        assert not self._unread, "a message is incomplete"
        return {
            "send_key": self._keys[0].hex(),
            "receive_key": self._keys[1].hex(),
            "sent": self._sent,
            "received": self._received,
            "is_encrypted": self.is_encrypted,
        }

    @classmethod
    def from_json(cls, state: dict[str, Any]) -> Channel:
        keys = bytes.fromhex(state["send_key"]), bytes.fromhex(state["receive_key"])
        return cls(*keys, state["sent"], state["received"], is_encrypted=state["is_encrypted"])


class _Authentication:
    """The protection of messages in one direction by an authentication tag. The messages are not encrypted."""

    def __init__(self, key: bytes) -> None:
        self._key = key

    def protect(self, number: int, header: bytes, payload: bytes) -> bytes:
        """Return the bytes of a message after its header."""
        return payload + hmac.digest(self._key, _NUMBER.pack(number) + header + payload, "sha256")[:TAG_BYTES]

    def open(self, number: int, header: bytes, body: bytes) -> bytes:
        """Return the payload of a message. Raises WireError."""
        payload = body[:-TAG_BYTES]
        if not hmac.compare_digest(body, self.protect(number, header, payload)):
            raise WireError("a message is not authentic")
        return payload


class _Encryption:
    """The protection of messages in one direction by encryption."""

    def __init__(self, key: bytes) -> None:
        from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

        self._cipher = ChaCha20Poly1305(key)

    def protect(self, number: int, header: bytes, payload: bytes) -> bytes:
        """Return the bytes of a message after its header."""
        return self._cipher.encrypt(_nonce(number), payload, header)

    def open(self, number: int, header: bytes, body: bytes) -> bytes:
        """Return the payload of a message. Raises WireError."""
        from cryptography.exceptions import InvalidTag

        try:
            return self._cipher.decrypt(_nonce(number), body, header)
        except InvalidTag:
            raise WireError("a message is not authentic") from None


def _nonce(number: int) -> bytes:
    return bytes(4) + _NUMBER.pack(number)


ADDRESS_BYTES = 4
"""Number of bytes of the sender's address, which precedes a datagram to the agent."""
NUMBER_BYTES = 4
"""Number of bytes of the request number. It precedes each request and its answer, so that answers can be assigned to
requests.
"""
SILENT_S = 2.0
"""A vehicle counts as cut off if no ping or pong arrives for this number of seconds of wall time."""
LOST_AFTER_S = 10.0
"""The kernel closes a connection if the other end acknowledges no data for this number of seconds of wall time."""


def prepare(connection: socket.socket) -> None:
    """Configure a connection: the kernel sends data without delay, and closes a dead connection after
    `LOST_AFTER_S`.
    """
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(LOST_AFTER_S * 1000))
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in ((socket.TCP_KEEPIDLE, 4), (socket.TCP_KEEPINTVL, 2), (socket.TCP_KEEPCNT, 3)):
        connection.setsockopt(socket.IPPROTO_TCP, option, value)


HANDED_OVER_BYTES = 4096
KEYS = "keys"
"""Name of a link in the directory of a far end. The link leads to a directory in memory, which holds the keys of a
secured mission.
"""


def hand_over(inside: socket.socket, connection: socket.socket, state: dict[str, Any]) -> None:
    """Send a connected socket and the state of its channel to the process inside the private network. Then close the
    socket in this process. Raises OSError.
    """
    with connection:
        socket.send_fds(inside, [json.dumps(state).encode()], [connection.fileno()])


def take_over(outside: socket.socket) -> tuple[socket.socket, dict[str, Any]] | None:
    """Receive a connected socket and the state of its channel from the process outside, and return them. Return None if
    that process has ended. Raises BlockingIOError if no socket has arrived.
    """
    data, descriptors, _, _ = socket.recv_fds(outside, HANDED_OVER_BYTES, 1)
    if not data:
        return None
    connection = socket.socket(fileno=descriptors[0])
    connection.setblocking(False)
    state: dict[str, Any] = json.loads(data)
    return connection, state
