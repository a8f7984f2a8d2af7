"""One TCP port of the embedded vehicle, for at most one client. It never blocks, and its memory is limited.

A client that reads too slowly loses telemetry, because the vehicle does not wait for a client. ArduPilot, in contrast,
waits if the speedup is above 1. A second client can connect, but receives nothing until the first client disconnects.
ArduPilot behaves in the same way.
"""

from __future__ import annotations

import contextlib
import selectors
import socket

from sitl._autopilot import Autopilot
from sitl.serial_channel import ClientChannel

READ_BYTES = 65_536
MAX_UNSENT_BYTES = 65_536


class VehiclePort:
    """A TCP server on 127.0.0.1 for one client. Raises OSError if the TCP port is not available."""

    def __init__(self, number: int, autopilot: Autopilot, selector: selectors.BaseSelector) -> None:
        self._autopilot = autopilot
        self._selector = selector
        self._client: socket.socket | None = None
        self._unsent = bytearray()
        self.channel: ClientChannel | None = None
        self._listener = socket.create_server(("127.0.0.1", number), backlog=16)
        self._listener.setblocking(False)
        self._await_client()

    def _await_client(self) -> None:
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def _accept(self, _events: int) -> None:
        try:
            self._client, _ = self._listener.accept()
        except OSError:  # the client has already disconnected
            return
        self._client.setblocking(False)
        self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.channel = ClientChannel(self._autopilot)
        self._selector.unregister(self._listener)
        self._selector.register(self._client, selectors.EVENT_READ, self._ready)

    def _ready(self, events: int) -> None:
        if events & selectors.EVENT_READ:
            self._read()
        if events & selectors.EVENT_WRITE and self._client is not None:
            self._write()

    def _read(self) -> None:
        assert self._client is not None and self.channel is not None
        try:
            data = self._client.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self.channel.receive(data)
        else:
            self._drop_client()

    def send(self) -> None:
        """Send the waiting messages, or discard them if the client is too slow.

        The port either sends or discards all waiting messages, so the client never receives part of a message.
        """
        if self._client is None or self.channel is None:
            return
        batch = self.channel.take()
        if batch and len(self._unsent) + len(batch) <= MAX_UNSENT_BYTES:
            self._unsent += batch
            self._write()

    def _write(self) -> None:
        assert self._client is not None
        try:
            sent = self._client.send(self._unsent)
        except BlockingIOError:
            sent = 0
        except OSError:
            self._drop_client()
            return
        del self._unsent[:sent]
        waiting = selectors.EVENT_WRITE if self._unsent else 0
        self._selector.modify(self._client, selectors.EVENT_READ | waiting, self._ready)

    def _drop_client(self) -> None:
        assert self._client is not None and self.channel is not None
        self._selector.unregister(self._client)
        with contextlib.suppress(OSError):
            self._client.close()
        self.channel.close()
        self._client = self.channel = None
        self._unsent.clear()
        self._await_client()
