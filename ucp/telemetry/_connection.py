"""Connect to a vehicle, request MAVLink messages, and forward the received bytes."""

import contextlib
import socket
from collections.abc import Callable
from functools import partial

from ucp.loop import Loop, ScheduledCall

MAX_READ_BYTES = 65536

_REQUESTED = {33: 1.0, 30: 1.0, 1: 2.0, 2: 2.0, 42: 1.0}
"""Message ID -> requested interval in simulated seconds. ArduPilot sends HEARTBEAT, STATUSTEXT and MISSION_ITEM_REACHED
without a request. After a request for MISSION_ITEM_REACHED, ArduPilot would also repeat the last of these messages at
intervals.
"""
_SET_MESSAGE_INTERVAL = 511  # MAV_CMD_SET_MESSAGE_INTERVAL

_COMPANION_SYSTEM, _COMPANION_COMPONENT = 255, 191  # MAV_COMP_ID_ONBOARD_COMPUTER

_FIRST_RETRY_S, _LAST_RETRY_S = 0.05, 1.0
_FIRST_REQUEST_S, _LAST_REQUEST_S = 1.0, 30.0


class VehicleConnection:
    """A connection to the vehicle at `host`:`port`. It passes all received bytes to `sink` until `close` is called.

    The object tries to connect until the vehicle accepts. It then requests the messages that `TelemetryEvents` needs.
    It connects again after a restart of the vehicle.
    """

    def __init__(self, loop: Loop, host: str, port: int, sink: Callable[[bytes], object]) -> None:
        self._loop = loop
        self._address = host, port
        self._sink = sink
        self._retry_s = _FIRST_RETRY_S
        self._socket: socket.socket | None = None
        self._retry_timer: ScheduledCall | None = None
        """The timer for the next attempt to connect, or for the next repetition of the requests."""
        self._connect()

    def close(self) -> None:
        """Close the connection and stop trying to connect. Afterwards `sink` is no longer called."""
        if self._retry_timer is not None:
            self._retry_timer.cancel()
        if self._socket is not None:
            self._loop.watch(self._socket)
            self._socket.close()
            self._socket = None

    def _connect(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._socket.setblocking(False)
        try:
            self._socket.connect(self._address)
        except BlockingIOError:
            self._loop.watch(self._socket, writable=self._connected)
        except OSError:
            self._retry()
        else:
            self._connected()

    def _retry(self) -> None:
        self.close()
        self._retry_timer = self._loop.call_later(self._retry_s, self._connect)
        self._retry_s = min(2 * self._retry_s, _LAST_RETRY_S)

    def _connected(self) -> None:
        assert self._socket is not None, "_connect opened it"
        if self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self._retry()
            return
        self._loop.watch(self._socket, readable=self._read)
        from pymavlink.dialects.v20 import common  # the import is slow

        self._mav = common.MAVLink(None, srcSystem=_COMPANION_SYSTEM, srcComponent=_COMPANION_COMPONENT)
        self._request_messages(_FIRST_REQUEST_S)

    def _read(self) -> None:
        assert self._socket is not None, "it is watched"
        try:
            data = self._socket.recv(MAX_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:  # a killed vehicle resets its connections
            data = b""
        if data:
            self._retry_s = _FIRST_RETRY_S
            self._sink(data)
        else:
            self._retry()  # after a pause, because a port may accept each connection and close it at once

    def _request_messages(self, pause_s: float) -> None:
        """Request the MAVLink messages, and repeat the requests with growing pauses.

        A vehicle that is booting may acknowledge a request and then forget it.
        """
        assert self._socket is not None, "it is connected"
        for message_id, interval_s in _REQUESTED.items():
            # target 0 means each system on this link. There is one.
            request = self._mav.command_long_encode(
                0, 0, _SET_MESSAGE_INTERVAL, 0, message_id, interval_s * 1e6, 0, 0, 0, 0, 0
            )
            # _read notices a lost connection, and the repeated request makes up for a full buffer
            with contextlib.suppress(OSError):
                self._socket.send(request.pack(self._mav))
            self._mav.seq = (self._mav.seq + 1) % 256
        self._retry_timer = self._loop.call_later(
            pause_s, partial(self._request_messages, min(2 * pause_s, _LAST_REQUEST_S))
        )
