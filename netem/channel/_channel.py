"""Simulate a radio channel that all vehicles share: sending times, carrier sense, collisions, hidden stations and
capture.

The model does no I/O and reads no clock. The events of the model are the beginnings and the ends of frames. The caller
advances the model to a given time. The same calls with the same seed give the same result on every machine, for three
reasons. Times are whole nanoseconds. Powers come from tables. Each station draws its backoff from its own random number
generator.

A receiver begins to receive a frame under three conditions. First, the receiver neither sends nor receives another
frame. Second, the power of the frame is at least `sensitivity_dbm`. Third, the frame is stronger by `preamble_db` than
the noise and all other frames together. The third condition must hold for `capture_window_s` from the beginning of the
frame. Within this time the receiver can change to a stronger frame (capture effect). The receiver loses the frame if it
begins to send before the end of the frame. It also loses the frame if the ratio of the frame's power to the noise and
all other frames ever falls below `sinr_db`.

Two stations that do not hear each other do not wait for each other. Their frames collide at a receiver that hears both
(hidden stations). A station that receives no frame senses the sum of all powers, and waits until this sum falls below
`energy_dbm`.

The model neglects the propagation time, which is 1 us for 300 m and is part of the slot time. The model draws no bit
errors. A fixed ratio of signal to interference decides whether a receiver loses a frame. In reality, a frame of 100
bytes goes from almost never lost to almost always lost within about 2 dB of this ratio.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import count
from operator import add
from random import Random

from netem.channel._access import NEVER, ChannelAccess, DutyCycle, TimeSlots
from netem.channel._contention import CarrierSense
from netem.channel._frame import EndedTransmission, FrameFate, RadioFrame
from netem.channel._links import RadioLinks, linear
from netem.channel._parameters import NANOSECONDS, LoraRadio, Radio, TimeSlotRadio, WifiRadio, nanoseconds
from netem.radio import Place


class Channel:
    """The radio channel between `vehicles`. The channel numbers the vehicles from 0, in the order of this argument.

    Times are seconds, and must not decrease from call to call. All vehicles are at the same place until the first call
    of `move`.
    """

    def __init__(self, vehicles: Sequence[int], radio: Radio, seed: int) -> None:
        self._radio = radio
        self._access = _access(radio, vehicles, seed)
        energy_dbm = radio.energy_dbm if isinstance(radio, WifiRadio) else radio.sensitivity_dbm
        self._links = RadioLinks(len(vehicles), radio, energy_dbm, Random(f"{seed}/shadowing"))
        self._queues: list[deque[RadioFrame]] = [deque() for _ in vehicles]
        self._active: list[RadioFrame] = []
        self._next_end = NEVER
        self._sending = 0
        """The stations that are sending, one bit for each station."""
        self._finished: list[EndedTransmission] = []
        self._numbers = count()
        self._airtimes: dict[int, int | None] = {}
        """Number of data bytes in a message -> nanoseconds that the message takes on the air. The value is None if the
        radio cannot send a message of this length.
        """
        self._silence = [linear(round(100 * radio.noise_dbm))] * len(vehicles)
        self._energy = self._silence[0] + linear(round(100 * energy_dbm)) if isinstance(radio, WifiRadio) else math.inf
        self._begins = 1 + linear(round(-100 * radio.preamble_db)) / linear(0)
        self._suffices = 1 + linear(round(-100 * radio.sinr_db)) / linear(0)
        self._capture_window = nanoseconds(radio.capture_window_s)

    def send(self, sender: int, now: float, data_bytes: int) -> int | FrameFate:
        """Put a message of this length into the queue of its sender. Return the number of the message's frame. If the
        radio drops the message, return FrameFate.QUEUE or FrameFate.TOO_LONG instead.
        """
        now_ns = nanoseconds(now)
        if self._next_end <= now_ns or self._access.next_due <= now_ns:
            self._play(now_ns)
        if data_bytes not in self._airtimes:
            self._airtimes[data_bytes] = self._airtime(data_bytes)
        airtime = self._airtimes[data_bytes]
        if airtime is None:
            return FrameFate.TOO_LONG
        queue = self._queues[sender]
        if len(queue) >= self._radio.queue_frames:
            return FrameFate.QUEUE
        frame = RadioFrame(next(self._numbers), sender, data_bytes, now_ns, airtime)
        queue.append(frame)
        if len(queue) == 1 and not self._sending >> sender & 1:
            self._access.wait(frame, now_ns, self._active)
        return frame.number

    def next_event(self) -> float | None:
        """Return the time in seconds at which the next frame begins or ends. Return None if all queues are empty."""
        ends, due = self._next_end, self._access.next_due
        next_ns = ends if ends < due else due
        return None if next_ns == NEVER else next_ns / NANOSECONDS

    def advance(self, now: float) -> list[EndedTransmission]:
        """Advance the channel to the time `now`. Return the transmissions that have ended since the previous call, in
        order.
        """
        self._play(nanoseconds(now))
        finished, self._finished = self._finished, []
        return finished

    def move(self, places: Sequence[Place], now: float) -> None:
        """Set the positions of the vehicles. For frames that are already on the air, the received powers do not
        change.
        """
        self._play(nanoseconds(now))
        self._links.move(places)

    def tune(self, groups: Sequence[int], now: float) -> None:
        """Assign a channel number to each vehicle. Vehicles on different channels do not affect each other.

        Frames on the air are still received on the old channel.
        """
        self._play(nanoseconds(now))
        self._links.tune(groups)

    def _airtime(self, data_bytes: int) -> int | None:
        airtime = self._radio.airtime_ns(data_bytes)
        return None if data_bytes > self._radio.largest_bytes or self._access.too_long(airtime) else airtime

    def _play(self, until: int) -> None:
        access = self._access
        while True:
            due, ends = access.next_due, self._next_end
            if ends > until and due > until:
                return
            if ends <= due:
                for frame in [frame for frame in self._active if frame.ends_ns == ends]:
                    self._end(frame, ends)
            else:
                self._begin(access.take_due(), due)

    def _begin(self, stations: list[int], now: int) -> None:
        frames = []
        for station in stations:
            frame = self._queues[station].popleft()
            frame.begins_ns, frame.ends_ns = now, now + frame.airtime_ns
            frame.reach = self._links.reach(station, now)
            self._sending |= 1 << station
            if frame.ends_ns < self._next_end:
                self._next_end = frame.ends_ns
            frames.append(frame)
        sensed = frames
        if len(frames) == 1 and not self._active:
            frames[0].receiving = frames[0].reach.heard
        else:
            sensed = frames + self._overlap(frames, now)
        self._active += frames
        self._access.begun(sensed, now)

    def _overlap(self, frames: list[RadioFrame], now: int) -> list[RadioFrame]:
        """Decide which receivers begin to receive each of these frames, and record the receivers at which frames on the
        air now disturb each other.

        Return the frames that are now sensed by further stations. A frame with power p is strong enough if p >= ratio *
        (total - p), which is the same as p * (1 + 1 / ratio) >= total.
        """
        for frame in self._active:
            frame.deaf |= frame.reach.heard & self._sending
            frame.receiving &= ~self._sending
        air = self._active + frames
        totals = self._silence
        for frame in air:
            totals = list(map(add, totals, frame.reach.powers))
        begins, suffices, occupied = self._begins, self._suffices, 0
        for frame in self._active:
            if now - frame.begins_ns <= self._capture_window:
                frame.receiving &= _sufficient(frame, totals, begins)
            occupied |= frame.receiving
        able = ~self._sending & ~occupied
        for frame in frames:
            frame.deaf = frame.reach.heard & self._sending
            frame.receiving = frame.reach.heard & able & _sufficient(frame, totals, begins)
        for frame in air:
            if frame.receiving:
                frame.disturbed |= frame.receiving & ~_sufficient(frame, totals, suffices)
        return self._sum_energy(air, totals)

    def _sum_energy(self, air: list[RadioFrame], totals: Sequence[float]) -> list[RadioFrame]:
        """Find the stations at which all frames on the air together reach the detection level. Such a station senses
        the channel as busy until the sum of the powers falls below the detection level. Return the frames that are now
        sensed by further stations.
        """
        level = self._energy
        by_end = sorted(air, key=lambda frame: frame.ends_ns, reverse=True)
        sensed = by_end[0].sensed
        changed = []
        for station, total in enumerate(totals):
            bit = 1 << station
            if total < level or sensed & bit:
                continue
            power = self._silence[station]
            for frame in by_end:
                if frame.sensed & bit:
                    break
                power += frame.reach.powers[station]
                if power >= level:
                    frame.summed |= bit
                    changed.append(frame)
                    break
        return changed

    def _end(self, frame: RadioFrame, now: int) -> None:
        self._active.remove(frame)
        self._next_end = min([other.ends_ns for other in self._active]) if self._active else NEVER
        self._sending &= ~(1 << frame.sender)
        queue = self._queues[frame.sender]
        self._access.ended(frame, queue[0] if queue else None, now, self._active)
        self._finished.append(EndedTransmission(frame))


def _sufficient(frame: RadioFrame, totals: Sequence[float], ratio: float) -> int:
    """Return the receivers at which the frame is strong enough: its power times `ratio` is at least the total power of
    all frames. Each bit of the result stands for one receiver.
    """
    receivers = 0
    for number in [number for number, power in enumerate(frame.reach.powers) if power * ratio >= totals[number]]:
        receivers |= 1 << number
    return receivers


def _access(radio: Radio, vehicles: Sequence[int], seed: int) -> ChannelAccess:
    if isinstance(radio, WifiRadio):
        return CarrierSense(radio, [Random(f"{seed}/backoff/{vehicle}") for vehicle in vehicles])
    if isinstance(radio, TimeSlotRadio):
        return TimeSlots(len(vehicles), radio)
    assert isinstance(radio, LoraRadio), f"no access rule for {type(radio).__name__}"
    return DutyCycle(len(vehicles), radio)
