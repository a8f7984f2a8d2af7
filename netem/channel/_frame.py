"""Represent a radio frame, from the time at which its sender queues it to the end of its transmission."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum

from netem.channel._links import FrameReach
from netem.channel._parameters import NANOSECONDS


class FrameFate(StrEnum):
    """The result of a frame at one receiver. A frame with the result QUEUE or TOO_LONG was never on the air."""

    RECEIVED = "received"
    COLLISION = "collision"
    """The frame collided with other frames: they were too strong at the receiver, or the receiver was already receiving
    another frame.
    """
    HALF_DUPLEX = "half_duplex"
    """The receiver was sending a frame itself at this time."""
    FADE = "fade"
    """The shadowing reduced the received power too much."""
    RANGE = "range"
    """The receiver is too far away, even without shadowing."""
    PARTITION = "partition"
    """The receiver listens to another channel."""
    QUEUE = "queue"
    """The queue of the sender was full."""
    TOO_LONG = "too_long"
    """The radio cannot send a frame of this length."""


@dataclass(slots=True, eq=False)
class RadioFrame:
    """A radio frame, from the time at which its sender queues it to the end of its transmission. Times are in
    nanoseconds. A set of receivers is an integer in which each bit stands for one receiver.
    """

    number: int
    sender: int
    data_bytes: int
    queued_ns: int
    airtime_ns: int
    begins_ns: int = 0
    ends_ns: int = 0
    reach: FrameReach = field(init=False)
    """The reception of the frame at each receiver. It is computed when the frame begins."""
    receiving: int = 0
    """Receivers that are receiving this frame."""
    disturbed: int = 0
    """Receivers at which other frames were too strong."""
    deaf: int = 0
    """Receivers in range that were sending a frame themselves."""
    summed: int = 0
    """Receivers that sense the channel as busy until this frame ends, only because the powers of several frames add
    up.
    """

    @property
    def sensed(self) -> int:
        """Stations that sense the channel as busy because of this frame."""
        return self.receiving | self.disturbed | self.reach.energetic | self.summed

    @property
    def received(self) -> int:
        return self.receiving & ~self.disturbed

    @property
    def collided(self) -> int:
        return self.reach.heard & ~self.received & ~self.deaf


class EndedTransmission:
    """A frame whose transmission has ended, with its result at each receiver."""

    __slots__ = ("_frame",)

    def __init__(self, frame: RadioFrame) -> None:
        self._frame = frame

    @property
    def number(self) -> int:
        """The number that `Channel.send` returned for the message."""
        return self._frame.number

    @property
    def sender(self) -> int:
        return self._frame.sender

    @property
    def data_bytes(self) -> int:
        return self._frame.data_bytes

    @property
    def queued_at(self) -> float:
        """The time in seconds at which `Channel.send` queued the message."""
        return self._frame.queued_ns / NANOSECONDS

    @property
    def began_at(self) -> float:
        return self._frame.begins_ns / NANOSECONDS

    @property
    def ended_at(self) -> float:
        return self._frame.ends_ns / NANOSECONDS

    @property
    def received(self) -> int:
        """The receivers that received the frame. Each bit stands for one receiver. Receiver 0 is the lowest bit."""
        return self._frame.received

    def lost(self) -> dict[FrameFate, int]:
        """Return reason -> the receivers that lost the frame for this reason. Each bit of the value stands for one
        receiver.
        """
        frame, reach = self._frame, self._frame.reach
        lost = {
            FrameFate.COLLISION: frame.collided,
            FrameFate.HALF_DUPLEX: frame.deaf,
            FrameFate.FADE: reach.faded,
            FrameFate.RANGE: reach.far,
            FrameFate.PARTITION: reach.cut,
        }
        return {fate: receivers for fate, receivers in lost.items() if receivers}

    def fate(self, receiver: int) -> FrameFate:
        """Return the result of the frame at this receiver. The receiver must not be the sender."""
        bit = 1 << receiver
        return next((fate for fate, receivers in self.lost().items() if receivers & bit), FrameFate.RECEIVED)


def numbers(receivers: int) -> Iterator[int]:
    """Yield the numbers of the receivers in this set (one bit for each receiver), in ascending order."""
    while receivers:
        lowest = receivers & -receivers
        yield lowest.bit_length() - 1
        receivers ^= lowest
