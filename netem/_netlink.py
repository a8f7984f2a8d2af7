"""Send requests to the kernel in batches through a netlink socket (rtnetlink(7)).

A lab of 100 vehicles needs about 900 requests. A system call and a wait for each single request would take most of the
start time of the lab. The socket belongs to the namespace in which it was opened.
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass

from netem.errors import NetlinkError

# linux/netlink.h, linux/rtnetlink.h
NLM_F_REQUEST = 0x001
NLM_F_ACK = 0x004
NLM_F_DUMP = 0x300
NLM_F_EXCL = 0x200
NLM_F_CREATE = 0x400
RTM_NEWLINK, RTM_GETLINK, RTM_SETLINK, RTM_NEWADDR, RTM_NEWROUTE = 16, 18, 19, 20, 24
RTM_NEWQDISC, RTM_DELQDISC, RTM_GETQDISC = 36, 37, 38
RTM_NEWTCLASS, RTM_DELTCLASS = 40, 41
RTM_NEWTFILTER, RTM_DELTFILTER, RTM_GETTFILTER = 44, 45, 46
_NLM_F_CAPPED = 0x100
_NLM_F_ACK_TLVS = 0x200
_NLMSG_ERROR = 2
_NLMSG_DONE = 3
_NLMSGERR_ATTR_MSG = 1
_SOL_NETLINK = 270
_NETLINK_CAP_ACK = 10
_NETLINK_EXT_ACK = 11

NEW = NLM_F_CREATE | NLM_F_EXCL

_HEADER = struct.Struct("=IHHII")
_BATCH = 50
_BATCH_BYTES = 64 << 10  # a socket accepts about three times as much at once


@dataclass(frozen=True)
class NetlinkRequest:
    """One request to the kernel. `what` is the name of the request in error messages."""

    what: str
    type: int
    message: bytes  # content after the header
    flags: int = 0


class NetlinkSocket:
    """A NETLINK_ROUTE socket in the caller's network namespace."""

    def __init__(self) -> None:
        kind = socket.SOCK_RAW | socket.SOCK_CLOEXEC
        self._socket = socket.socket(socket.AF_NETLINK, kind, socket.NETLINK_ROUTE)
        self._socket.bind((0, 0))
        # Request the kernel's error message in addition to the number, and no copy of the request.
        for option in (_NETLINK_EXT_ACK, _NETLINK_CAP_ACK):
            self._socket.setsockopt(_SOL_NETLINK, option, 1)
        self._sequence = 0

    def close(self) -> None:
        self._socket.close()

    def send(self, requests: Sequence[NetlinkRequest]) -> None:
        """Send the requests in order, and wait until the kernel has processed all of them.

        Raises NetlinkError for the first request that the kernel refuses. The kernel then still executes the later
        requests of the same batch.
        """
        batch: list[NetlinkRequest] = []
        encoded = bytearray()
        for request in requests:
            message = self._encode(request.message, request.type, request.flags | NLM_F_ACK)
            if len(batch) == _BATCH or (batch and len(encoded) + len(message) > _BATCH_BYTES):
                self._send(batch, encoded, self._sequence - len(batch))
                batch, encoded = [], bytearray()
            batch.append(request)
            encoded += message
        if batch:
            self._send(batch, encoded, self._sequence - len(batch) + 1)

    def _send(self, requests: Sequence[NetlinkRequest], encoded: bytes | bytearray, first: int) -> None:
        self._socket.send(encoded)
        error: NetlinkError | None = None
        waiting = len(requests)
        while waiting:
            for kind, flags, sequence, payload in self._receive():
                if kind != _NLMSG_ERROR:
                    continue
                waiting -= 1
                if error is None:
                    error = _refusal(requests[sequence - first].what, flags, payload)
        if error is not None:
            raise error

    def dump(self, what: str, kind: int, message: bytes) -> list[bytes]:
        """Return all entries that the kernel lists for a GET request, without their headers."""
        self._socket.send(self._encode(message, kind, NLM_F_DUMP))
        entries: list[bytes] = []
        while True:
            for kind, flags, _, payload in self._receive():
                if kind == _NLMSG_DONE:
                    return entries
                if kind == _NLMSG_ERROR:
                    if error := _refusal(what, flags, payload):
                        raise error
                    return entries
                entries.append(payload)

    def _encode(self, message: bytes, kind: int, flags: int) -> bytes:
        self._sequence += 1
        length = _HEADER.size + len(message)
        return _HEADER.pack(length, kind, flags | NLM_F_REQUEST, self._sequence, 0) + message

    def _receive(self) -> list[tuple[int, int, int, bytes]]:
        data = self._socket.recv(1 << 18)
        messages = []
        offset = 0
        while offset + _HEADER.size <= len(data):
            length, kind, flags, sequence, _ = _HEADER.unpack_from(data, offset)
            messages.append((kind, flags, sequence, data[offset + _HEADER.size : offset + length]))
            offset += (length + 3) & ~3
        return messages


def _refusal(what: str, flags: int, payload: bytes) -> NetlinkError | None:
    code = -int(struct.unpack_from("=i", payload)[0])
    if code == 0:
        return None
    word = os.strerror(code)
    if flags & _NLM_F_ACK_TLVS and flags & _NLM_F_CAPPED:
        offset = 4 + _HEADER.size
        while offset + 4 <= len(payload):
            length, kind = struct.unpack_from("=HH", payload, offset)
            if kind == _NLMSGERR_ATTR_MSG:
                word += f" ({payload[offset + 4 : offset + length].rstrip(bytes(1)).decode(errors='replace')})"
            offset += max(4, (length + 3) & ~3)
    return NetlinkError(f"{what}: {word}", code)
