"""An event loop for sockets, timers and signals, smaller than asyncio.

`asyncio` offers the same functions. But the import of `asyncio` takes longer than all other steps of an agent's start
together. It also takes as much memory as all other steps. With more agents than processors, the start of a swarm would
mostly consist of this import.
"""

import heapq
import selectors
import signal
import socket
import time
from collections.abc import Callable
from itertools import count

Callback = Callable[[], object]


class ScheduledCall:
    """A scheduled call of a function. `cancel` prevents it."""

    __slots__ = ("callback",)

    def __init__(self, callback: Callback) -> None:
        self.callback: Callback | None = callback

    def cancel(self) -> None:
        self.callback = None


class Loop:
    """An event loop. `run` calls functions one after another when they are due, until `stop` is called.

    If a callback raises an exception, the loop calls `on_error` with the exception and continues. Without `on_error`,
    the exception ends the loop. `selector` waits for sockets. The default selector rounds waiting times up to
    milliseconds.
    """

    def __init__(
        self, on_error: Callable[[Exception], object] | None = None, selector: selectors.BaseSelector | None = None
    ) -> None:
        self.on_error = on_error
        self._selector = selector or selectors.DefaultSelector()
        self._callbacks: dict[socket.socket, tuple[Callback | None, Callback | None]] = {}
        self._timers: list[tuple[float, int, ScheduledCall]] = []
        self._order = count()
        self._running = True
        self._wakeup_sender: socket.socket | None = None

    def watch(self, sock: socket.socket, *, readable: Callback | None = None, writable: Callback | None = None) -> None:
        """Call a function whenever the socket can be read or written. Without functions, stop watching the socket."""
        events = (selectors.EVENT_READ if readable else 0) | (selectors.EVENT_WRITE if writable else 0)
        if sock in self._callbacks and events:
            self._selector.modify(sock, events)
        elif events:
            self._selector.register(sock, events)
        elif self._callbacks.pop(sock, None):
            self._selector.unregister(sock)
        if events:
            self._callbacks[sock] = readable, writable

    def call_later(self, delay_s: float, callback: Callback) -> ScheduledCall:
        """Call a function after `delay_s` seconds of wall time. A negative delay counts as 0."""
        timer = ScheduledCall(callback)
        heapq.heappush(self._timers, (time.monotonic() + max(0.0, delay_s), next(self._order), timer))
        return timer

    def stop_on(self, *signals: int) -> None:
        """Let these signals stop the loop until `close` is called."""
        wakeup_receiver, self._wakeup_sender = socket.socketpair()
        for end in (wakeup_receiver, self._wakeup_sender):
            end.setblocking(False)
        signal.set_wakeup_fd(self._wakeup_sender.fileno(), warn_on_full_buffer=False)
        self.watch(wakeup_receiver, readable=lambda: wakeup_receiver.recv(64))
        for number in signals:
            signal.signal(number, lambda *_: self.stop())

    def stop(self) -> None:
        self._running = False

    def run(self) -> None:
        """Call the due functions until `stop` is called. The caller may run the loop again afterwards."""
        while self._running:
            self._call_back(self._selector.select(self._seconds_to_next_timer()))
            self._call_due_timers()
        self._running = True

    def close(self) -> None:
        """Stop watching sockets and signals. The caller closes the sockets that it opened."""
        if self._wakeup_sender is not None:
            signal.set_wakeup_fd(-1)
            self._wakeup_sender.close()
        self._callbacks.clear()
        self._selector.close()

    def _call_back(self, ready: list[tuple[selectors.SelectorKey, int]]) -> None:
        """Call the functions of the sockets that can be read or written."""
        for key, events in ready:
            readable, writable = self._callbacks.get(key.fileobj, (None, None))  # type: ignore[call-overload]
            self._call(readable if events & selectors.EVENT_READ and readable else writable)

    def _seconds_to_next_timer(self) -> float | None:
        """Return the number of seconds until the next scheduled call. Return None if no call is scheduled."""
        return max(0.0, self._timers[0][0] - time.monotonic()) if self._timers else None

    def _call_due_timers(self) -> None:
        now = time.monotonic()
        while self._running and self._timers and self._timers[0][0] <= now:
            self._call(heapq.heappop(self._timers)[2].callback)

    def _call(self, callback: Callback | None) -> None:
        if callback is None or not self._running:
            return
        try:
            callback()
        except Exception as error:
            if self.on_error is None:
                raise
            self.on_error(error)
