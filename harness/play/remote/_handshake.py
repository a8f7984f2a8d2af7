"""Perform the handshake of a new connection, in which both ends prove that they know the secret.

    harness -> agent    CHALLENGE || nonce of the harness
    agent -> harness    length || hello || nonce of the agent || HMAC(secret, "UCP hello" || both nonces || hello)
    harness -> agent    length || welcome || HMAC(secret, "UCP welcome" || both nonces || hello || welcome)

`hello` and `welcome` are JSON objects. A refusal is a `welcome` with the key `refused`, one sentence. The key `share`
has a public key (`_key_exchange`). The keys of the connection follow from the secret, both nonces and the key
exchange. If both ends sent a public key, the connection is encrypted. An attacker cannot remove a public key, because
the tags cover `hello` and `welcome`. All parts have a maximum size, and the handshake has a time limit.
The hash is HMAC-SHA256. The secret has 256 random bits, so a recorded handshake does not reveal it.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import secrets
import socket
import struct
from dataclasses import dataclass
from typing import Any

from harness.play.remote._key_exchange import KeyExchange
from harness.play.remote._wire import Channel
from ucp.plain_file import parse_json

PROTOCOL = "ucp-join/1"
HANDSHAKE_LIMIT_S = 5.0
MAX_TEXT_BYTES = 4096
_CHALLENGE = b"UCPJOIN1"
_NONCE_BYTES = 32
_LENGTH = struct.Struct("!H")
_TAG_BYTES = 32


class HandshakeError(Exception):
    """An error: the other end of a connection has another secret or protocol. The message has no subject, because the
    caller puts the name of the other end before it.
    """


class RefusedError(Exception):
    """An error: the harness refused the agent. The message is the sentence that the harness sent."""


@dataclass(frozen=True)
class Hello:
    """The verified first message of a far end (an agent on another computer). `words` is the JSON object in this
    message without the public key.
    """

    words: dict[str, Any]
    connection: socket.socket
    _secret: bytes
    _nonces: bytes
    _hello: bytes
    _exchange: KeyExchange
    _shared: bytes | None

    @property
    def is_encrypted(self) -> bool:
        return self._shared is not None

    async def answer(self, welcome: dict[str, Any]) -> Channel:
        """Send the last message of the handshake. Return the channel of the connection. Raises OSError."""
        data = json.dumps({**welcome, "share": self._exchange.share}).encode()
        tag = _mac(self._secret, b"UCP welcome", self._nonces, self._hello, data)
        loop = asyncio.get_running_loop()
        await loop.sock_sendall(self.connection, _LENGTH.pack(len(data)) + data + tag)
        to_agent, to_lab = _keys(self._secret, self._nonces, self._shared)
        return Channel(to_agent, to_lab, is_encrypted=self.is_encrypted)


async def receive_hello(connection: socket.socket, secret: bytes) -> Hello:
    """Send a challenge over a new connection, and return the answer of the far end after checking it. Raises
    HandshakeError or OSError.
    """
    loop = asyncio.get_running_loop()
    own = secrets.token_bytes(_NONCE_BYTES)
    async with asyncio.timeout(HANDSHAKE_LIMIT_S):
        await loop.sock_sendall(connection, _CHALLENGE + own)
        hello = await _text(connection)
        rest = await _receive_exactly(connection, _NONCE_BYTES + _TAG_BYTES)
        nonces = own + rest[:_NONCE_BYTES]
        if not hmac.compare_digest(rest[_NONCE_BYTES:], _mac(secret, b"UCP hello", nonces, hello)):
            data = json.dumps({"refused": "the secret is wrong"}).encode()
            await loop.sock_sendall(connection, _LENGTH.pack(len(data)) + data + bytes(_TAG_BYTES))
            raise HandshakeError("has another secret")
    words, exchange = _parsed(hello), KeyExchange()
    return Hello(words, connection, secret, nonces, hello, exchange, _shared(exchange, words))


async def introduce(connection: socket.socket, secret: bytes, hello: dict[str, Any]) -> tuple[Channel, dict[str, Any]]:
    """Answer the challenge of the harness. Return the channel of the connection, and the `welcome` that the harness
    sent. Raises RefusedError, HandshakeError or OSError.
    """
    loop = asyncio.get_running_loop()
    async with asyncio.timeout(HANDSHAKE_LIMIT_S):
        challenge = await _receive_exactly(connection, len(_CHALLENGE) + _NONCE_BYTES)
        if not challenge.startswith(_CHALLENGE):
            raise HandshakeError("is not a harness of this version")
        own, exchange = secrets.token_bytes(_NONCE_BYTES), KeyExchange()
        words = json.dumps({**hello, "share": exchange.share}).encode()
        nonces = challenge[len(_CHALLENGE) :] + own
        tag = _mac(secret, b"UCP hello", nonces, words)
        await loop.sock_sendall(connection, _LENGTH.pack(len(words)) + words + own + tag)
        data = await _text(connection)
        answered = await _receive_exactly(connection, _TAG_BYTES)
    if not hmac.compare_digest(answered, _mac(secret, b"UCP welcome", nonces, words, data)):
        raise HandshakeError("has another secret: copy the secret file of the harness to this computer")
    welcome = _parsed(data)
    if "refused" in welcome:
        raise RefusedError(str(welcome["refused"]))
    shared = _shared(exchange, welcome)
    to_agent, to_lab = _keys(secret, nonces, shared)
    return Channel(to_lab, to_agent, is_encrypted=shared is not None), welcome


def _shared(exchange: KeyExchange, words: dict[str, Any]) -> bytes | None:
    """Remove the public key of the other end from `words`. Return the secret that both ends compute in the key
    exchange. Return None if an end lacks the package cryptography. Raises HandshakeError if the public key is invalid.
    """
    try:
        return exchange.shared(words.pop("share", None))
    except ValueError:
        raise HandshakeError("sent a wrong public key") from None


def _mac(secret: bytes, *parts: bytes) -> bytes:
    """Return the authentication tag of these parts. Each part is preceded by its length, so that an attacker cannot
    move bytes between parts.
    """
    return hmac.digest(secret, b"".join(struct.pack("!I", len(part)) + part for part in parts), "sha256")


def _keys(secret: bytes, nonces: bytes, shared: bytes | None) -> tuple[bytes, bytes]:
    """Return the keys of both directions: to the agent, and to the lab."""
    parts = nonces, shared or b""
    return _mac(secret, b"UCP to agent", *parts), _mac(secret, b"UCP to lab", *parts)


def _parsed(data: bytes) -> dict[str, Any]:
    try:
        value = parse_json(data)
    except ValueError:
        value = None
    if not isinstance(value, dict):
        raise HandshakeError("did not send a JSON object")
    return value


async def _text(connection: socket.socket) -> bytes:
    (length,) = _LENGTH.unpack(await _receive_exactly(connection, _LENGTH.size))
    if length > MAX_TEXT_BYTES:
        raise HandshakeError(f"sent {length} bytes, and at most {MAX_TEXT_BYTES} are allowed")
    return await _receive_exactly(connection, length)


async def _receive_exactly(connection: socket.socket, count: int) -> bytes:
    loop = asyncio.get_running_loop()
    data = b""
    while len(data) < count:
        part = await loop.sock_recv(connection, count - len(data))
        if not part:
            raise HandshakeError("closed the connection during the handshake")
        data += part
    return data
