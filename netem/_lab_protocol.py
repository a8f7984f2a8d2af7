"""Define the messages between the harness and its virtual network. Each message is a JSON object after a length prefix,
on a Unix stream socket.

A message can carry open sockets as SCM_RIGHTS (unix(7)). The key `descriptors` of such a message contains the number of
its sockets. Sender and receiver use the sockets in the same order.
"""

from __future__ import annotations

import array
import json
import os
import socket
import struct
from collections import deque
from typing import Any

MAX_MESSAGE = 32 << 20  # bytes; conditions of 10,000 links are about 3 MB

_LENGTH = struct.Struct("!I")
_MAX_DESCRIPTORS = 64


class WireError(Exception):
    """An error: the stream contains invalid data, so the rest of the stream cannot be used."""


def encode(message: dict[str, Any]) -> bytes:
    body = json.dumps(message, separators=(",", ":")).encode()
    if len(body) > MAX_MESSAGE:
        raise WireError(f"a message of {len(body)} bytes; allowed are {MAX_MESSAGE}")
    return _LENGTH.pack(len(body)) + body


class MessageReceiver:
    """Divides the data of a socket into messages and file descriptors."""

    def __init__(self) -> None:
        self._data = bytearray()
        self.descriptors: deque[int] = deque()

    def read(self, source: socket.socket) -> bool:
        """Read available data. Return False at the end of the stream. Raises BlockingIOError if no data are
        available.
        """
        room = socket.CMSG_SPACE(_MAX_DESCRIPTORS * array.array("i").itemsize)
        data, ancillary, _, _ = source.recvmsg(1 << 16, room, socket.MSG_CMSG_CLOEXEC)
        for level, kind, payload in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
                self.descriptors.extend(array.array("i", payload))
        self._data += data
        return bool(data)

    def messages(self) -> list[dict[str, Any]]:
        """Return the complete messages. Raises WireError for an invalid stream."""
        messages = []
        while len(self._data) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._data)
            if length > MAX_MESSAGE:
                raise WireError(f"a message of {length} bytes; allowed are {MAX_MESSAGE}")
            end = _LENGTH.size + length
            if len(self._data) < end:
                break
            body = bytes(self._data[_LENGTH.size : end])
            del self._data[:end]
            try:
                message = json.loads(body)
            except (ValueError, RecursionError) as error:
                raise WireError(f"a message that is no JSON: {error}") from error
            if not isinstance(message, dict):
                raise WireError("a message that is no JSON object")
            messages.append(message)
        return messages

    def close(self) -> None:
        while self.descriptors:
            os.close(self.descriptors.popleft())
