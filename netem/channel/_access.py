"""Define two rules by which a radio decides when to send. With the first rule, it sends only in its own time slots.
With the second, it sends immediately unless its duty cycle forbids this.

The module `netem.channel._contention` contains the rule of IEEE 802.11.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Protocol

from netem.channel._frame import RadioFrame
from netem.channel._parameters import LoraRadio, TimeSlotRadio, nanoseconds

NEVER = 1 << 62
"""A time in nanoseconds that stands for "never". Every run ends earlier."""


class ChannelAccess(Protocol):
    """A rule for access to the channel. Stations are numbered from 0, and times are nanoseconds."""

    next_due: int
    """The time at which the next station will send, unless a frame begins or a new frame is queued before this time.
    NEVER if no station has a frame.
    """

    def take_due(self) -> list[int]:
        """Return the stations that send at the time `next_due`, and remove them from the waiting stations."""

    def wait(self, frame: RadioFrame, now: int, active: Collection[RadioFrame]) -> None:
        """Choose the time at which the sender of `frame` will send it. `active` contains the frames that are on the air
        now.
        """

    def begun(self, frames: list[RadioFrame], now: int) -> None:
        """Update the sending times of waiting stations, because these frames begin. `take_due` has just returned the
        senders of these frames.
        """

    def ended(self, frame: RadioFrame, waiting: RadioFrame | None, now: int, active: Collection[RadioFrame]) -> None:
        """Update the sending times of waiting stations, because `frame` ends. `waiting` is the next frame in the queue
        of its sender, or None.
        """

    def too_long(self, airtime_ns: int) -> bool:
        """Return true if the rule never allows a frame that takes this time on the air."""


class DutyCycle:
    """The access rule of stations that send immediately, unless their duty cycle forbids this.

    After a frame of T seconds, the station is silent until T / duty seconds after the beginning of this frame. This is
    the duty cycle of ETSI EN 300 220, as LoRaWAN devices apply it.
    """

    def __init__(self, count: int, radio: LoraRadio | TimeSlotRadio) -> None:
        self.next_due = NEVER
        self._due: dict[int, int] = {}
        self._duty = radio.duty
        self._silent_until = [0] * count

    def take_due(self) -> list[int]:
        stations = [station for station, due in self._due.items() if due == self.next_due]
        for station in stations:
            del self._due[station]
        self.next_due = min(self._due.values(), default=NEVER)
        return stations

    def wait(self, frame: RadioFrame, now: int, active: Collection[RadioFrame]) -> None:
        due = self._due[frame.sender] = self._chosen(frame, max(now, self._silent_until[frame.sender]))
        self.next_due = min(self.next_due, due)

    def begun(self, frames: list[RadioFrame], now: int) -> None:
        for frame in frames:
            self._silent_until[frame.sender] = now + math.ceil(frame.airtime_ns / self._duty)

    def ended(self, frame: RadioFrame, waiting: RadioFrame | None, now: int, active: Collection[RadioFrame]) -> None:
        if waiting is not None:
            self.wait(waiting, now, active)

    def too_long(self, airtime_ns: int) -> bool:
        return False

    def _chosen(self, frame: RadioFrame, earliest: int) -> int:
        return earliest


class TimeSlots(DutyCycle):
    """The access rule of a station that sends only in its own time slot. If a frame does not fit into the rest of the
    current slot, the frame waits for the station's next slot.
    """

    def __init__(self, count: int, radio: TimeSlotRadio) -> None:
        super().__init__(count, radio)
        self._turn = nanoseconds(radio.turn_s)
        self._usable = self._turn - nanoseconds(radio.guard_s)
        self._round = count * self._turn

    def too_long(self, airtime_ns: int) -> bool:
        return airtime_ns > self._usable

    def _chosen(self, frame: RadioFrame, earliest: int) -> int:
        into = (earliest - frame.sender * self._turn) % self._round
        fits = into + frame.airtime_ns <= self._usable
        return earliest if fits else earliest - into + self._round
