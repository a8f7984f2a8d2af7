"""Decide when each broadcast on a shared radio channel reaches each vehicle, without I/O and without a clock.

The model and the random numbers are the same as in virtual time. A message of an agent waits for its processing time
and in the queue of its radio. When its frame ends, the conditions of the network apply to each copy that the channel
delivers. Other broadcasts, such as ARP requests, do not use the channel, and only the conditions apply to them.

The caller is always slightly late: it calls `send` after the broadcast was sent, and `advance` after the time of an
event. It passes the exact times of both. Lateness therefore delays deliveries, but changes no other decision of the
model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count
from typing import NamedTuple

from harness.play._shared_channel import NEVER, ChannelTotals, ChannelTraffic, Journal
from netem.channel import Radio, numbers
from netem.conditions import NetworkConditions
from netem.medium import AT_ONCE, Medium, RandomDraws
from netem.radio import Place


@dataclass(slots=True, eq=False)
class _ChannelMessage:
    frame: bytes
    sequence: int | None
    """The sequence number of the message in the frame, or None if the frame contains no message of an agent."""


class FrameDelivery(NamedTuple):
    """A frame that reaches a vehicle at mission second `at_s`."""

    at_s: float
    order: int
    """A number that determines the order of simultaneous deliveries."""
    vehicle: int
    frame: bytes


class LiveChannel:
    """The shared radio channel of the agents in `roster`. Times are mission seconds, and must not decrease between
    calls.
    """

    def __init__(self, roster: Sequence[int], radio: Radio, processing_s: float, seed: int, journal: Journal) -> None:
        self._roster = tuple(roster)
        self._number = {vehicle: number for number, vehicle in enumerate(roster)}
        self._traffic: ChannelTraffic[_ChannelMessage] = ChannelTraffic(
            self._roster, radio, processing_s, seed, journal
        )
        self._medium = Medium(self._roster, seed, AT_ONCE)
        self._due: list[FrameDelivery] = []
        self._order = count()
        self._played_s = 0.0

    @property
    def totals(self) -> ChannelTotals:
        return self._traffic.totals

    @property
    def next_s(self) -> float:
        """The mission second of the next event, or NEVER if no further event is scheduled."""
        return min(self._traffic.next_s, self._due[0].at_s if self._due else NEVER)

    def send(self, at_s: float, vehicle: int, frame: bytes, data_bytes: int, sequence: int | None) -> None:
        """Let a vehicle send this frame on the channel. `data_bytes` is the length of the message in the frame."""
        at_s = max(at_s, self._played_s)
        self._traffic.send(at_s, self._number[vehicle], _ChannelMessage(frame, sequence), data_bytes)

    def pass_by(self, at_s: float, vehicle: int, frame: bytes) -> None:
        """Let a vehicle broadcast this frame without using the channel."""
        sender = self._number[vehicle]
        everyone = (1 << len(self._roster)) - 1
        self._copy(at_s, self._medium.draw(sender, at_s, len(frame)), everyone, frame)

    def advance(self, now: float) -> list[FrameDelivery]:
        """Simulate all events up to the time `now`. Return the deliveries that are due, in order."""
        self._play(now)
        deliveries = []
        while self._due and self._due[0].at_s <= now:
            deliveries.append(heappop(self._due))
        return deliveries

    def move(self, places: Sequence[Place], now: float) -> None:
        """Set the positions of the vehicles, in the order of the roster."""
        self._play(now)
        self._traffic.move(places, now)

    def apply(self, conditions: NetworkConditions, now: float) -> None:
        """Apply these network conditions to all frames whose transmission ends after `now`. In a partition, each group
        has its own channel.
        """
        self._play(now)
        self._medium.apply(conditions)
        groups = conditions.groups(self._roster)
        self._traffic.tune(
            [next(index for index, group in enumerate(groups) if vehicle in group) for vehicle in self._roster], now
        )

    def _play(self, now: float) -> None:
        traffic = self._traffic
        while traffic.next_s <= now:
            at_s = traffic.next_s
            for transmission, message in traffic.advance():
                draws = self._medium.draw(transmission.sender, at_s, transmission.data_bytes)
                self._copy(at_s, draws, transmission.received, message.frame)
        self._played_s = max(self._played_s, now)

    def _copy(self, at_s: float, draws: RandomDraws, receivers: int, frame: bytes) -> None:
        """Schedule the arrival of a frame at these receivers. Random losses and delays apply. `receivers` is a number
        with a bit for each receiver.
        """
        for receiver in numbers(receivers):
            for delay_s in draws.copies_to(receiver):
                heappush(self._due, FrameDelivery(at_s + delay_s, next(self._order), self._roster[receiver], frame))
