"""Measure the clock of a far computer and the delay of the connection, as NTP does (RFC 5905, section 8).

A ping has the sending time t1 of this machine. The pong adds the time t2 of the far computer, and arrives at t3. If the
ping and the pong take the same time, the far clock is ahead by t2 - (t1 + t3) / 2. If the two ways take different
times, the error is at most half of the round trip time t3 - t1. The ping with the shortest round trip is therefore the
best one.

The far computer sends two times. Its wall clock gives the offset, because an agent reads the wall clock when its
mission begins. Its monotonic clock gives the drift, because nothing sets that clock.
"""

import struct
import time
from collections import deque
from dataclasses import dataclass
from statistics import quantiles
from typing import Any

from harness.play.remote._wire import WireError

RECENT = 40
"""Number of the latest pings from which the clock offset is chosen."""
MAX_DELAYS = 10_000
_PING = struct.Struct("!d")
_PONG = struct.Struct("!dddQ")


@dataclass(frozen=True)
class _Sample:
    at_s: float
    round_trip_s: float
    wall_offset_s: float
    monotonic_offset_s: float


def ping() -> bytes:
    """Return the payload of a ping that is sent now."""
    return _PING.pack(time.monotonic())


def pong(payload: bytes, datagrams: int) -> bytes:
    """Return the answer to a ping. `datagrams` is the number of datagrams that the agent has sent so far. Raises
    WireError.
    """
    if len(payload) != _PING.size:
        raise WireError("a ping has a wrong length")
    (sent,) = _PING.unpack(payload)
    return _PONG.pack(sent, time.time(), time.monotonic(), datagrams)


class FarClock:
    """The measured clock of a far computer, relative to the clock of this machine."""

    def __init__(self) -> None:
        self._recent: deque[_Sample] = deque(maxlen=RECENT)
        self._first: _Sample | None = None
        self._delays: deque[float] = deque(maxlen=MAX_DELAYS)

    def receive(self, payload: bytes) -> int:
        """Add the measurement in a pong. Return the number of datagrams that the pong reports. Raises WireError."""
        if len(payload) != _PONG.size:
            raise WireError("a pong has a wrong length")
        sent, wall, monotonic, datagrams = _PONG.unpack(payload)
        now, wall_now = time.monotonic(), time.time()
        round_trip = now - sent
        middle = sent + round_trip / 2
        sample = _Sample(now, round_trip, wall - (wall_now - now + middle), monotonic - middle)
        self._recent.append(sample)
        if self._first is None or (now - self._first.at_s < 1.0 and round_trip < self._first.round_trip_s):
            self._first = sample
        self._delays.append(round_trip / 2)
        return int(datagrams)

    @property
    def samples(self) -> int:
        return len(self._recent)

    @property
    def offset_s(self) -> float:
        """Seconds by which the wall clock of the far computer is ahead."""
        return self._shortest().wall_offset_s

    @property
    def uncertainty_s(self) -> float:
        """Maximum error of the offset in seconds."""
        return self._shortest().round_trip_s / 2

    def drift(self) -> float | None:
        """Return the relative error of the rate of the far clock. Return None if the measurements do not show this
        error.
        """
        last, first = self._shortest(), self._first
        if first is None or last.at_s - first.at_s < 10.0:
            return None
        return (last.monotonic_offset_s - first.monotonic_offset_s) / (last.at_s - first.at_s)

    @property
    def delay_s(self) -> float:
        """The median delay in one direction, in seconds of wall time."""
        return self._quantiles()[9]

    def to_json(self) -> dict[str, Any]:
        """Return the measurement for run.json."""
        at = self._quantiles()
        drift = self.drift()
        return {
            "offset_s": round(self.offset_s, 6),
            "uncertainty_s": round(self.uncertainty_s, 6),
            "drift": None if drift is None else round(drift, 9),
            "delay_s": round(at[9], 6),
            "delay_p95_s": round(at[18], 6),
            "delay_most_s": round(max(self._delays), 6),
            "pings": len(self._delays),
        }

    def _quantiles(self) -> list[float]:
        return quantiles(self._delays, n=20, method="inclusive") if len(self._delays) > 1 else [*self._delays] * 19

    def _shortest(self) -> _Sample:
        return min(self._recent, key=lambda sample: sample.round_trip_s)
