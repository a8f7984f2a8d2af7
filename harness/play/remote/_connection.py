"""Send and receive messages over one TCP connection, in an event loop."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable, Iterable

from harness.play.remote._wire import Channel, Kind, Message, WireError


class Connection(asyncio.Protocol):
    """One TCP connection between a stand-in and a far end. The function `lost` is called when the connection
    has ended.
    """

    def __init__(self, channel: Channel, receive: Callable[[Message], None], lost: Callable[[Connection], None]):
        self._channel, self._receive, self._lost = channel, receive, lost
        self._transport: asyncio.WriteTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        try:
            for message in self._channel.decode(data):
                self._receive(message)
        except WireError as error:
            sys.stderr.write(f"the connection ends: {error}\n")
            self.close()

    def connection_lost(self, error: Exception | None) -> None:
        self._transport = None
        self._lost(self)

    def send(self, kind: Kind, payload: bytes = b"") -> None:
        """Send a message. If the connection has ended, do nothing."""
        self.send_together([(kind, payload)])

    def send_together(self, messages: Iterable[tuple[Kind, bytes]]) -> None:
        """Send several messages together, so that the other end of the connection wakes up only once."""
        if self._transport is not None:
            self._transport.write(b"".join(self._channel.encode(kind, payload) for kind, payload in messages))

    @property
    def is_encrypted(self) -> bool:
        return self._channel.is_encrypted

    @property
    def unsent(self) -> int:
        return 0 if self._transport is None else self._transport.get_write_buffer_size()

    def close(self) -> None:
        if self._transport is not None:
            self._transport.abort()
