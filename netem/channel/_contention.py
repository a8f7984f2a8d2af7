"""Simulate carrier sense and the random waiting time (backoff) of IEEE 802.11 broadcasts (IEEE 802.11-2020, 10.3.4).

A station with a frame sends immediately if the channel has been idle for DIFS. If the channel is busy, the station
draws a number of slots from 0 to the contention window. It begins to count after DIFS, counts down one slot whenever
the channel was idle for the duration of a slot, and sends at 0. After a frame the station draws a new number, even if
it has no further frame. A broadcast is never acknowledged, so the contention window never grows. After a frame with an
error, a station waits for the longer interval EIFS instead of DIFS.

A station senses a frame only `sense_s` after the beginning of the frame. If the counters of two stations reach 0 in the
same slot, both stations therefore send.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Sequence
from random import Random

from netem.channel._access import NEVER
from netem.channel._frame import RadioFrame
from netem.channel._parameters import WifiRadio, nanoseconds

_WORD_BITS = 32


class CarrierSense:
    """The random waiting times of all stations before they send. `draws` contains a random number generator for each
    station.
    """

    def __init__(self, radio: WifiRadio, draws: Sequence[Random]) -> None:
        self.next_due = NEVER
        self._due: dict[int, int] = {}
        """Station with a waiting frame -> the time at which the station will send this frame, unless another frame
        begins before.
        """
        self._draws = draws
        self._choices = radio.contention_window + 1
        self._slot = nanoseconds(radio.slot_s)
        self._difs = nanoseconds(radio.difs_s)
        self._eifs = nanoseconds(radio.eifs_s)
        self._sense = nanoseconds(radio.sense_s)
        self._left = [0] * len(draws)
        """Station -> number of slots that the station must still count down. The countdown starts at the station's time
        in `_from`.
        """
        self._from = [0] * len(draws)
        """Station -> the time at which its countdown starts or has started."""
        self._resting: dict[int, int] = {}
        """Station that counts down although it has no frame to send -> the time at which its countdown ends. A station
        always counts down after it has sent a frame.
        """
        self._over: deque[RadioFrame] = deque()
        """Frames that ended less than EIFS ago."""

    def take_due(self) -> list[int]:
        stations = [station for station, due in self._due.items() if due == self.next_due]
        for station in stations:
            del self._due[station]
        return stations

    def wait(self, frame: RadioFrame, now: int, active: Collection[RadioFrame]) -> None:
        station = frame.sender
        self._resting.pop(station, None)
        left = self._counted(station, now)
        if active and (busy_until := self._busy_until(station, now, active)):
            if left == 0:
                self._left[station] = self._drawn(station)
            self._from[station] = max(self._from[station], busy_until + self._difs)
        elif left == 0:
            self._from[station] = self._idle_from(station, now)
        due = self._due[station] = max(now, self._from[station] + self._left[station] * self._slot)
        self.next_due = min(self.next_due, due)

    def begun(self, frames: list[RadioFrame], now: int) -> None:
        """Make each station that senses these frames wait. A station whose sending time is at most `sense_s` after
        `now` sends nevertheless, because it cannot sense the frames so soon.
        """
        all_due, all_from, all_left, slot, notices = self._due, self._from, self._left, self._slot, now + self._sense
        resting = self._resting
        for station in [station for station, counted in resting.items() if counted <= now]:
            del resting[station]
        if not all_due and not resting:
            self.next_due = NEVER
            return
        busy = [(frame.ends_ns + self._difs, frame.sensed) for frame in frames]
        busy.sort(reverse=True)
        next_due = NEVER
        for station, due in all_due.items():
            if due > notices:
                for idle_from, sensed in busy:
                    if sensed >> station & 1:
                        left, since = all_left[station], all_from[station]
                        if left and since < now:
                            left = all_left[station] = left - (now - since) // slot
                        if left == 0:
                            left = all_left[station] = self._drawn(station)
                        if since < idle_from:
                            since = all_from[station] = idle_from
                        due = all_due[station] = since + left * slot
                        break
            if due < next_due:
                next_due = due
        self.next_due = next_due
        for station in resting:
            for idle_from, sensed in busy:
                if sensed >> station & 1:
                    since = all_from[station]
                    if since < now:
                        all_left[station] -= (now - since) // slot
                    if since < idle_from:
                        since = all_from[station] = idle_from
                    resting[station] = since + all_left[station] * slot
                    break

    def ended(self, frame: RadioFrame, waiting: RadioFrame | None, now: int, active: Collection[RadioFrame]) -> None:
        if failed := frame.receiving & frame.disturbed:
            self._wait_for_longer(failed, now)
        station = frame.sender
        left = self._left[station] = self._drawn(station)
        busy_until = self._busy_until(station, now, active) if active else now
        self._from[station] = max(now, busy_until) + self._difs
        counted = self._from[station] + left * self._slot
        if waiting is not None:
            self._due[station] = counted
            self.next_due = min(self.next_due, counted)
        elif left:
            self._resting[station] = counted
        self._over.append(frame)
        while self._over[0].ends_ns + self._eifs < now:
            self._over.popleft()

    def too_long(self, airtime_ns: int) -> bool:
        return False

    def _wait_for_longer(self, stations: int, now: int) -> None:
        """Make these stations wait for the longer interval EIFS instead of DIFS from now on."""
        early, late = now + self._difs, now + self._eifs
        for station in (*self._due, *self._resting):
            if stations >> station & 1 and self._from[station] == early:
                self._from[station] = late
                counted = late + self._left[station] * self._slot
                if station in self._due:
                    self._due[station] = counted
                else:
                    self._resting[station] = counted
        self.next_due = min(self._due.values(), default=NEVER)

    def _counted(self, station: int, now: int) -> int:
        """Return the number of slots that this station still has to count down: its previous number minus the slots
        that have passed.
        """
        left = self._left[station]
        if left and now > self._from[station]:
            passed = (now - self._from[station]) // self._slot
            left = self._left[station] = max(0, left - passed)
            self._from[station] += passed * self._slot
        return left

    def _drawn(self, station: int) -> int:
        return self._draws[station].getrandbits(_WORD_BITS) * self._choices >> _WORD_BITS

    def _busy_until(self, station: int, now: int, active: Iterable[RadioFrame]) -> int:
        """Return the end time of the last frame that the station senses now. Return 0 if it senses none."""
        began_by = now - self._sense
        return max(
            (frame.ends_ns for frame in active if frame.sensed >> station & 1 and frame.begins_ns <= began_by),
            default=0,
        )

    def _idle_from(self, station: int, now: int) -> int:
        """Return the time from which the station may count slots: the end of the last frame that the station sensed,
        plus DIFS or EIFS. If no such frame ended recently, return `now`.
        """
        for frame in reversed(self._over):
            if frame.sensed >> station & 1:
                failed = frame.receiving & frame.disturbed
                return frame.ends_ns + (self._eifs if failed >> station & 1 else self._difs)
        return now
