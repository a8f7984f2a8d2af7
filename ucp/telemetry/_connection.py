"""The connection to a vehicle: what it sends goes to the translator, and it is asked for what the translator wants."""

import contextlib
import socket
from collections.abc import Callable
from functools import partial

from ucp.loop import Loop, Timer

MAX_READ_BYTES = 65536

_REQUESTED = {33: 1.0, 30: 1.0, 1: 2.0, 2: 2.0, 42: 1.0}
"""Message ID: interval in simulated seconds. HEARTBEAT, STATUSTEXT and MISSION_ITEM_REACHED come unasked; at an
interval ArduPilot would repeat which mission item it reached last."""
_SET_MESSAGE_INTERVAL = 511  # MAV_CMD_SET_MESSAGE_INTERVAL

_COMPANION_SYSTEM, _COMPANION_COMPONENT = 255, 191  # MAV_COMP_ID_ONBOARD_COMPUTER

_FIRST_RETRY_S, _LAST_RETRY_S = 0.05, 1.0
_FIRST_REQUEST_S, _LAST_REQUEST_S = 1.0, 30.0


class VehicleConnection:
    """Hands everything that the vehicle at `host`:`port` sends to `sink`, until `close`.

    Waits for the vehicle to listen, asks it for the messages that `TelemetryEvents` wants, and connects again when it
    restarts.
    """

    def __init__(self, loop: Loop, host: str, port: int, sink: Callable[[bytes], object]) -> None:
        self._loop = loop
        self._address = host, port
        self._sink = sink
        self._retry_s = _FIRST_RETRY_S
        self._socket: socket.socket | None = None
        self._next: Timer | None = None
        """When it tries to connect again, or asks again."""
        self._connect()

    def close(self) -> None:
        """Nothing comes to the sink any more."""
        if self._next is not None:
            self._next.cancel()
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
            self._try_again()
        else:
            self._connected()

    def _try_again(self) -> None:
        self.close()
        self._next = self._loop.call_later(self._retry_s, self._connect)
        self._retry_s = min(2 * self._retry_s, _LAST_RETRY_S)

    def _connected(self) -> None:
        assert self._socket is not None, "it was to be connected"
        if self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self._try_again()
            return
        self._loop.watch(self._socket, readable=self._read)
        from pymavlink.dialects.v20 import common  # which takes its time

        self._mav = common.MAVLink(None, srcSystem=_COMPANION_SYSTEM, srcComponent=_COMPANION_COMPONENT)
        self._ask(_FIRST_REQUEST_S)

    def _read(self) -> None:
        assert self._socket is not None, "it is watched"
        try:
            data = self._socket.recv(MAX_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:  # a vehicle that is killed resets its connections
            data = b""
        if data:
            self._retry_s = _FIRST_RETRY_S
            self._sink(data)
        else:
            self._try_again()  # not at once: a port that accepts and closes is not hammered

    def _ask(self, pause_s: float) -> None:
        """Ask for the messages, and again ever more seldom: a vehicle that is booting acknowledges and forgets."""
        assert self._socket is not None, "it is connected"
        for message_id, interval_s in _REQUESTED.items():
            # target 0: every system on this link, which is one
            request = self._mav.command_long_encode(
                0, 0, _SET_MESSAGE_INTERVAL, 0, message_id, interval_s * 1e6, 0, 0, 0, 0, 0
            )
            with contextlib.suppress(OSError):  # it is told by what is read, or does not read: it is asked again
                self._socket.send(request.pack(self._mav))
            self._mav.seq = (self._mav.seq + 1) % 256
        self._next = self._loop.call_later(pause_s, partial(self._ask, min(2 * pause_s, _LAST_REQUEST_S)))
