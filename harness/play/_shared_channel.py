"""Simulate a radio channel that all agents share, in virtual time and in real time.

A message waits for the processing time of its agent, and then in the queue of its radio. It arrives at the end of its
radio frame, if it arrives at all. `ChannelTraffic` records which frame carries which message, and counts the results.
It reads no clock: the caller passes the times.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from random import Random
from typing import Generic, Protocol, TypeVar

from netem.channel import Channel, EndedTransmission, FrameFate, Radio, numbers
from netem.radio import Place

Journal = Callable[[dict[str, object]], None]
"""A function that records a message on the channel. The record contains the time at which the agent passed the message
to its radio, the time at which the radio sent the message, and the vehicles at which it was lost.
"""

NEVER = float("inf")
LOAD_S = 1.0
"""Length in seconds of the intervals in which the load of the channel is measured."""

_WORD_BITS = 32


class _SentFrame(Protocol):
    @property
    def sequence(self) -> int | None:
        """The sequence number of the message in the frame, or None if the frame contains other data than a message of
        an agent.
        """


Message = TypeVar("Message", bound=_SentFrame)


class ChannelTraffic(Generic[Message]):
    """The messages that wait for a shared radio channel, or that are in transmission on it."""

    def __init__(
        self, roster: Sequence[int], radio: Radio, processing_s: float, seed: int, journal: Journal | None
    ) -> None:
        self.next_s = NEVER
        """The time of the next event: a message reaches its radio, or a frame begins or ends."""
        self.totals = ChannelTotals(roster)
        self._roster = roster
        self._journal = journal
        self._channel = Channel(roster, radio, seed)
        self._processing_s = processing_s / (1 << _WORD_BITS)
        self._draws = [Random(f"{seed}/processing/{agent_id}") for agent_id in roster]
        self._processed: list[tuple[float, int, int, int, Message]] = []
        self._processed_at = [0.0] * len(roster)
        self._order = 0
        self._queued: dict[int, Message] = {}
        """The message that each frame carries, by frame number."""

    def send(self, now: float, sender: int, message: Message, data_bytes: int) -> None:
        """Send a message on the channel as soon as the radio of the agent is free. The messages of one agent keep their
        order.
        """
        at = now + self._draws[sender].getrandbits(_WORD_BITS) * self._processing_s
        at = self._processed_at[sender] = max(at, self._processed_at[sender])
        self._order += 1
        heappush(self._processed, (at, self._order, sender, data_bytes, message))
        if at < self.next_s:
            self.next_s = at

    def advance(self) -> list[tuple[EndedTransmission, Message]]:
        """Advance the channel to the next event, and return the frames whose transmission ends then."""
        now, processed = self.next_s, self._processed
        while processed and processed[0][0] <= now:
            at, _, sender, data_bytes, message = heappop(processed)
            number = self._channel.send(sender, at, data_bytes)
            if isinstance(number, FrameFate):
                self.totals.dropped(sender, number)
                if self._journal is not None:
                    self._journal({**self._line(at, sender, message, data_bytes), "dropped": number.value})
            else:
                self._queued[number] = message
        ended = []
        for frame in self._channel.advance(now):
            message = self._queued.pop(frame.number)
            ended.append((frame, message))
            self.totals.ended(frame)
            if self._journal is not None:
                self._journal(self._line_of(frame, message))
        event = self._channel.next_event()
        self.next_s = NEVER if event is None else event
        if processed and processed[0][0] < self.next_s:
            self.next_s = processed[0][0]
        return ended

    def _line(self, at: float, sender: int, message: Message, data_bytes: int) -> dict[str, object]:
        identity = {"sender": self._roster[sender], "sequence": message.sequence, "bytes": data_bytes}
        return {"at_s": round(at, 6), **identity}

    def _line_of(self, frame: EndedTransmission, message: Message) -> dict[str, object]:
        lost = {fate.value: [self._roster[number] for number in numbers(bits)] for fate, bits in frame.lost().items()}
        times = {"began_s": round(frame.began_at, 6), "ended_s": round(frame.ended_at, 6)}
        return {**self._line(frame.queued_at, frame.sender, message, frame.data_bytes), **times, "lost": lost}

    def move(self, places: Sequence[Place], now: float) -> None:
        self._channel.move(places, now)

    def tune(self, groups: Sequence[int], now: float) -> None:
        self._channel.tune(groups, now)


class ChannelTotals:
    """Counts of a shared channel: sent frames, lost frames of each receiver, dropped messages of each sender, and the
    load of the channel over time.
    """

    def __init__(self, roster: Sequence[int]) -> None:
        self.frames = 0
        self.airtime_s = 0.0
        self._roster = roster
        self._all = (1 << len(roster)) - 1
        self._receivers: dict[FrameFate, BitCounter] = {}
        self._drops: dict[FrameFate, Counter[int]] = {}
        self._load: list[float] = []
        self._busy_until = 0.0

    def ended(self, frame: EndedTransmission) -> None:
        began_at, ended_at = frame.began_at, frame.ended_at
        self.frames += 1
        self.airtime_s += ended_at - began_at
        for fate, receivers in frame.lost().items() if frame.received | 1 << frame.sender != self._all else ():
            counter = self._receivers.get(fate)
            if counter is None:
                counter = self._receivers[fate] = BitCounter()
            counter.add(receivers)
        began_at = max(began_at, self._busy_until)
        if ended_at > began_at:
            self._busy_until = ended_at
            self._occupy(began_at, ended_at)

    def dropped(self, sender: int, fate: FrameFate) -> None:
        self._drops.setdefault(fate, Counter())[sender] += 1

    def _occupy(self, began_at: float, ended_at: float) -> None:
        """Count an interval in which the channel was busy."""
        while began_at < ended_at:
            index = int(began_at / LOAD_S)
            until = min(ended_at, (index + 1) * LOAD_S)
            if len(self._load) <= index:
                self._load.extend([0.0] * (index + 1 - len(self._load)))
            self._load[index] += until - began_at
            began_at = until

    def to_json(self) -> dict[str, object]:
        """Return the counts as a JSON object for run.json."""
        lost = {fate.value: self._by_id(counter.counts()) for fate, counter in sorted(self._receivers.items())}
        return {
            "frames": self.frames,
            "airtime_s": round(self.airtime_s, 6),
            "lost": lost,
            "dropped": {fate.value: self._by_id(counts) for fate, counts in sorted(self._drops.items())},
            "load_interval_s": LOAD_S,
            "load": [busy_s and round(busy_s / LOAD_S, 4) for busy_s in self._load],
        }

    def _by_id(self, counts: "dict[int, int] | Counter[int]") -> dict[str, int]:
        return {str(self._roster[number]): count for number, count in sorted(counts.items()) if count}


class BitCounter:
    """A counter for sets of small numbers. For each number, it counts the added sets that contain this number. The
    caller passes a set as an integer with a bit for each member.

    The counts are stored as binary digits. One integer holds the same digit of all counts. A set is added to all counts
    at once by a ripple-carry addition, which takes two steps on average, regardless of the number of counts.
    """

    def __init__(self) -> None:
        self._digits: list[int] = []
        """The binary digits of all counts. The first element holds the lowest digit of each count."""

    def add(self, bits: int) -> None:
        for place, digit in enumerate(self._digits):
            self._digits[place] = digit ^ bits
            bits &= digit
            if not bits:
                return
        if bits:
            self._digits.append(bits)

    def counts(self) -> dict[int, int]:
        """Return the number of added sets that contain each number. Numbers that occur in no set are omitted."""
        counts: Counter[int] = Counter()
        for place, digit in enumerate(self._digits):
            for number in numbers(digit):
                counts[number] += 1 << place
        return dict(counts)
