"""Deliver broadcasts in virtual time. Seeded random numbers determine losses and delays.

The medium is the third engine beside tc netem and nftables. It applies the same conditions without a kernel and without
packets. Losses and delays are drawn separately for each receiver of a broadcast. If the conditions have neither a delay
nor a rate, the latency is uniform from 2 to 50 ms, as over a radio. If they have only a rate, the rate determines the
latency.

First, a partition may drop the packet. The packet then passes the steps of netem_enqueue in Linux
(net/sched/sch_netem.c) in this order: duplication and loss together, corruption, the limit of the queue, the second
copy with its own draws, the delay, and the rate.

Each sender has a separate random number generator for each purpose, such as loss, latency or duplication. A further
fault, or more messages of one sender, therefore do not change the random numbers of other senders. A random number has
32 bits and is compared only with integers, so a seed gives the same results on every machine.

In a swarm of 200 agents most random numbers are never used, because an answer matters only to one agent. The medium
therefore draws random numbers in large blocks. A broadcast stores the index of its first random number in the block,
and reads its random numbers only when they are needed.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from math import inf
from random import Random
from typing import Protocol

from netem._distributions import SCALE, table
from netem.conditions import NetworkConditions
from netem.link import Delay, GilbertElliott, LinkConditions

LATENCY = Delay(mean_s=0.026, jitter_s=0.024)
"""Latency of messages if the conditions have neither a delay nor a rate."""

AT_ONCE = Delay(0.0)
_HEADERS = 42  # bytes of a frame beside the datagram's data: Ethernet, IPv4, UDP
_WORD = 1 << 32
_BROADCASTS_AT_ONCE = 64
_TABLE_SIZE = 4096


class RandomDraws(Protocol):
    """The losses and delays of one broadcast at all receivers, drawn at random. Receivers are numbered from 0 in the
    order of the vehicles.
    """

    latest: float
    """Upper bound, in seconds, of the time from sending to the arrival of any copy."""

    def copies_to(self, receiver: int) -> tuple[float, ...]:
        """Return the delay in seconds of each copy of the packet that arrives at this receiver."""

    def to_all(self) -> list[tuple[int, float]]:
        """Return (receiver, delay in seconds) for each copy of the packet that arrives, in the order of receivers."""


class Medium:
    """The simulated network between `vehicles`. Network conditions are perfect until `apply` is called."""

    def __init__(self, vehicles: Sequence[int], seed: int, latency: Delay = LATENCY) -> None:
        self.latency = latency
        """Latency of messages if the conditions have neither a delay nor a rate. A new value takes effect at the next
        call of `apply`.
        """
        self._vehicles = tuple(vehicles)
        self._seed = seed
        self._words = [
            _RandomWords(self._stream("loss", sender), self._stream("latency", sender)) for sender in vehicles
        ]
        self._rare: dict[int, tuple[Random, ...]] = {}  # by sender, if its links were ever not plain
        self._links: list[list[_Link]] = [[] for _ in vehicles]  # of each sender to all; empty if its links are plain
        self.soonest = latency.mean_s
        self.latest = latency.mean_s
        """Upper bound, in seconds, of the delay of any message that was sent so far or is sent under the current
        conditions. `soonest` is the lower bound.
        """
        self.apply(NetworkConditions())

    def apply(self, conditions: NetworkConditions) -> None:
        """Apply these network conditions to broadcasts from now on. Raises ConditionsError for an unknown vehicle.

        Messages in transit are not affected. A link keeps its queue if the old and the new conditions both need a
        queue. As in a kernel, loss in bursts starts in the good state after each change of the link's conditions.
        """
        conditions.validate(self._vehicles)
        group = {
            vehicle: index for index, members in enumerate(conditions.groups(self._vehicles)) for vehicle in members
        }
        self._group = [group[vehicle] for vehicle in self._vehicles]
        self._air = [self._air_of(number, sender, conditions) for number, sender in enumerate(self._vehicles)]
        self.soonest = min(self.soonest, *(air.soonest_of_all for air in self._air))
        self.latest = max(self.latest, *(air.latest for air in self._air))

    def certain_delays(self) -> tuple[float, float] | None:
        """Return the smallest and the largest delay in seconds. Return None if the medium may lose or duplicate a
        message at random.
        """
        if not all(air.certain for air in self._air):
            return None
        return min(air.soonest_of_all for air in self._air), max(air.latest for air in self._air)

    def hears(self, sender: int, receiver: int) -> bool:
        """Return true if no partition separates the two vehicles. Both arguments are indexes of vehicles from 0, not
        IDs.
        """
        return self._group[sender] == self._group[receiver]

    def draw(self, sender: int, now: float, data_bytes: int) -> RandomDraws:
        """Return the random results of a broadcast of `data_bytes` bytes, sent at the time `now` in seconds.

        `sender` is the index of a vehicle from 0, not its ID. The calls for one sender must be in time order.
        """
        return self._air[sender].draw(now, data_bytes)

    def _air_of(self, number: int, sender: int, conditions: NetworkConditions) -> _SenderLinks:
        links = [conditions.link(sender, receiver) for receiver in self._vehicles]
        hears = [number != index and self.hears(number, index) for index in range(len(links))]
        if all(_is_plain(link) for link in set(links)):
            self._links[number] = []
            return _PlainSenderLinks(links, hears, self._words[number], self.latency)
        before: Sequence[_Link | None] = self._links[number] or [None] * len(links)
        self._links[number] = [_Link(link, earlier, self.latency) for link, earlier in zip(links, before, strict=True)]
        if number not in self._rare:
            concerns = ("duplication", "reordering", "corruption")
            self._rare[number] = tuple(self._stream(concern, sender) for concern in concerns)
        return _GeneralSenderLinks(self._links[number], hears, self._words[number], self._rare[number])

    def _stream(self, concern: str, sender: int) -> Random:
        return Random(f"{self._seed}/{concern}/{sender}")


class _SenderLinks(Protocol):
    """The links of one sender under unchanged network conditions."""

    soonest_of_all: float
    latest: float
    certain: bool
    """True if random numbers have no effect, because each receiver receives each broadcast exactly once, or never."""

    def draw(self, now: float, data_bytes: int) -> RandomDraws: ...


_Way = tuple[int, float, float]
"""A link as three numbers: (threshold, base, factor). A packet is lost if its first random number is below the
threshold. Otherwise its delay in seconds is the base plus the factor multiplied by its second random number.
"""

_NO_WAY: _Way = (_WORD, 0.0, 0.0)


def _loss_and_delay(link: LinkConditions, latency: Delay) -> _Way:
    delay = link.delay or latency
    return round(link.independent_loss * _WORD), delay.mean_s - delay.jitter_s, 2 * delay.jitter_s / _WORD


def _is_plain(link: LinkConditions) -> bool:
    """Return true if a packet needs only one random number for loss and one for latency."""
    uniform = link.delay is None or link.delay.distribution == "uniform"
    return uniform and not (link.duplicate or link.reorder or link.corrupt or link.remembers)


class _PlainSenderLinks:
    """Links with independent loss and uniform latency. Each receiver needs two random numbers of 32 bits."""

    def __init__(self, links: list[LinkConditions], hears: list[bool], words: _RandomWords, latency: Delay) -> None:
        self.receivers = len(links)
        self.ways = [
            _loss_and_delay(link, latency) if heard else _NO_WAY for link, heard in zip(links, hears, strict=True)
        ]
        self.reached = [(receiver, *way) for receiver, way in enumerate(self.ways) if way != _NO_WAY]
        self.certain = all(lost_below in (0, _WORD) for _, lost_below, _, _ in self.reached)
        delays = [link.delay or latency for link in links]
        self.soonest_of_all = min(delay.mean_s - delay.jitter_s for delay in delays)
        self.latest = max(delay.mean_s + delay.jitter_s for delay in delays)
        self._words = words

    def draw(self, now: float, data_bytes: int) -> RandomDraws:
        words = self._words
        at = words.next
        if at + self.receivers > len(words.loss):
            at = words.refill(self.receivers)
        words.next = at + self.receivers
        return _PlainDraws(self, words.loss, words.latency, at, self.latest)


class _PlainDraws:
    """The random results of one broadcast. The object stores an index into the arrays of random numbers, and computes
    each result on demand.
    """

    __slots__ = ("_air", "_at", "_latency", "_loss", "latest")

    def __init__(self, air: _PlainSenderLinks, loss: array[int], latency: array[int], at: int, latest: float) -> None:
        self._air = air
        self._loss = loss
        self._latency = latency
        self._at = at
        self.latest = latest

    def copies_to(self, receiver: int) -> tuple[float, ...]:
        lost_below, soonest, per_lot = self._air.ways[receiver]
        word = self._at + receiver
        if self._loss[word] < lost_below:
            return ()
        return (soonest + self._latency[word] * per_lot,)

    def to_all(self) -> list[tuple[int, float]]:
        at, loss, latency = self._at, self._loss, self._latency
        return [
            (receiver, soonest + latency[at + receiver] * per_lot)
            for receiver, lost_below, soonest, per_lot in self._air.reached
            if loss[at + receiver] >= lost_below
        ]


class _RandomWords:
    """Two streams of 32-bit random numbers, which are drawn in blocks. The numbers from index `next` on are unused."""

    def __init__(self, loss: Random, latency: Random) -> None:
        self.loss = array("I")
        self.latency = array("I")
        self._streams = loss, latency
        self.next = 0

    def take(self, count: int) -> int:
        """Return the index of the next `count` random numbers in the arrays `loss` and `latency`. The index stays valid
        for these arrays, because `refill` creates new arrays and never changes the old ones.
        """
        at = self.next
        if at + count > len(self.loss):
            at = self.refill(count)
        self.next = at + count
        return at

    def refill(self, count: int) -> int:
        """Draw a new block of random numbers, and return the index of the first unused one."""
        loss, latency = self._streams
        self.loss = self.loss[self.next :] + _draw(loss, _BROADCASTS_AT_ONCE * count)
        self.latency = self.latency[self.next :] + _draw(latency, _BROADCASTS_AT_ONCE * count)
        return 0


def _draw(stream: Random, count: int) -> array[int]:
    words = array("I", stream.randbytes(4 * count))
    if sys.byteorder == "big":
        words.byteswap()
    return words


class _GeneralSenderLinks:
    """Links with any network conditions. The random numbers of each receiver are independent of those of the other
    receivers.
    """

    soonest_of_all = 0.0
    latest = inf
    certain = False

    def __init__(self, links: list[_Link], hears: list[bool], words: _RandomWords, rare: tuple[Random, ...]) -> None:
        self._links = links
        self._hears = hears
        self._words = words
        self._duplication, self._reordering, self._corruption = rare

    def draw(self, now: float, data_bytes: int) -> RandomDraws:
        bits = 8 * (data_bytes + _HEADERS)
        return _RepeatedDraws([self._delays(receiver, now, bits) for receiver in range(len(self._links))])

    def _delays(self, receiver: int, now: float, bits: int) -> tuple[float, ...]:
        words = self._words
        at = words.take(2)
        loss, turn, latency = words.loss[at] / _WORD, words.loss[at + 1] / _WORD, words.latency[at] / _WORD
        first = loss, turn, self._corruption.random(), self._reordering.random(), latency
        duplication = self._duplication.random()
        if not self._hears[receiver]:
            return ()
        link = self._links[receiver]
        second = None
        if duplication < link.conditions.duplicate:
            own = Random(int(duplication * _WORD))
            second = own.random(), own.random(), own.random(), own.random(), own.random()
        return link.enqueue(now, bits, first, second)


_Copy = tuple[float, float, float, float, float]
"""The random numbers for one copy of a packet, each uniform between 0 and 1: loss, change of the loss model's state,
corruption, reordering, latency.
"""


class _Link:
    """The link from one sender to one receiver, with its state between packets. `before` is the link under the previous
    conditions. The new link takes over the queue of `before` if both the old and the new conditions need a queue.
    """

    def __init__(self, conditions: LinkConditions, before: _Link | None, latency: Delay = LATENCY) -> None:
        self.conditions = conditions
        self._delay = conditions.delay or (latency if conditions.rate is None else AT_ONCE)
        self._bad = False
        self._last = -inf  # time at which the last packet leaves
        self._departures: list[float] = []  # heap: when each waiting packet leaves, or has left
        if before is not None and conditions.remembers and before.conditions.remembers:
            self._bad = before._bad and conditions == before.conditions
            self._last, self._departures = before._last, before._departures

    def enqueue(self, now: float, bits: int, draws: _Copy, second: _Copy | None = None) -> tuple[float, ...]:
        """Send a packet at the time `now`. Return the delay in seconds of each copy that arrives. If the random numbers
        `second` are given, the packet is duplicated, so up to two copies arrive.
        """
        conditions = self.conditions
        loss, turn, corruption, reordering, latency = draws
        lost = self._loses(loss, turn)
        if lost and second is None:
            return ()
        if conditions.limit is not None and self._waiting(now) >= conditions.limit:
            return ()
        # The second copy is sent first. If a packet is both lost and duplicated, one copy remains.
        copies = self.enqueue(now, bits, second) if second is not None and not lost else ()
        delay_s = 0.0 if reordering < conditions.reorder else self._wait(now, bits, latency)
        if corruption < conditions.corrupt:  # the receiver discards a corrupted packet
            return copies
        return (delay_s, *copies)

    def _loses(self, draw: float, turn: float) -> bool:
        loss, bad = self.conditions.loss, self._bad
        if not isinstance(loss, GilbertElliott):
            return draw < loss
        self._bad = turn >= loss.r if bad else turn < loss.p
        return draw < (loss.loss_bad if bad else loss.loss_good)

    def _wait(self, now: float, bits: int, latency: float) -> float:
        """Put a packet into the queue of the link, and return its delay in seconds."""
        at = now + sample(self._delay, latency)
        if self.conditions.rate is not None:
            if self._last > now:
                at = max(at, self._last)
            at += bits / self.conditions.rate
        self._last = max(self._last, at)
        heappush(self._departures, at)
        self._waiting(now)
        return max(0.0, at - now)

    def _waiting(self, now: float) -> int:
        """Return the number of packets in the queue of the link."""
        while self._departures and self._departures[0] <= now:
            heappop(self._departures)
        return len(self._departures)


@dataclass
class _RepeatedDraws:
    delays: list[tuple[float, ...]]

    def __post_init__(self) -> None:
        self.latest = max((delay for copies in self.delays for delay in copies), default=0.0)

    def copies_to(self, receiver: int) -> tuple[float, ...]:
        return self.delays[receiver]

    def to_all(self) -> list[tuple[int, float]]:
        return [(receiver, delay) for receiver, copies in enumerate(self.delays) for delay in copies]


def sample(delay: Delay, lot: float) -> float:
    """Convert a random number between 0 and 1 to a delay in seconds with this distribution. As in netem, a negative
    delay becomes 0.
    """
    if delay.distribution == "uniform":
        return delay.mean_s + delay.jitter_s * (2 * lot - 1)
    deviations = table(delay.distribution, _TABLE_SIZE)[int(lot * _TABLE_SIZE)] / SCALE
    return delay.mean_s + delay.jitter_s * deviations
