"""The air in virtual time: what becomes of a broadcast on its way to each receiver, drawn from a seed.

It is the third engine beside tc netem and nftables, for agents that run in no kernel: the same conditions, and no
packets. A broadcast is drawn for by every receiver on its own. Without a delay in the conditions a message takes 2 to
50 ms, uniformly, as over a radio.

Every sender has a random stream of its own for each concern: loss, latency, duplication, and so on. A fault that is
added, or another sender that says more, changes none of the others' lots. Lots are words of 32 bits, and what they are
compared with are whole numbers or tables of them, so that a seed means the same on every machine.

With 200 agents on the air most lots are never looked at: an answer matters to one agent of the 200. So words are drawn
many at a time, a broadcast knows where its own stand, and they are read when somebody asks.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from random import Random
from typing import Protocol

from netem.conditions import NetworkConditions
from netem.distributions import SCALE, table
from netem.link import Delay, GilbertElliott, LinkConditions

LATENCY = Delay(mean_s=0.026, jitter_s=0.024)
"""How long messages take where the conditions do not say."""

_WORD = 1 << 32
_BROADCASTS_AT_ONCE = 64
_TABLE_SIZE = 4096


class Lots(Protocol):
    """The lots of one broadcast. Receivers are numbered in the order in which the medium was given its vehicles."""

    latest: float
    """No copy arrives later than this many seconds after it was sent."""

    def copies_to(self, receiver: int) -> tuple[float, ...]:
        """The delay in seconds of every copy that reaches `receiver`."""

    def to_all(self) -> list[tuple[int, float]]:
        """(receiver, delay in seconds) of every copy that arrives anywhere, by receiver."""


class Medium:
    """What `vehicles` hear of each other. Conditions are perfect until `apply`."""

    def __init__(self, vehicles: Sequence[int], seed: int) -> None:
        self._vehicles = tuple(vehicles)
        self._seed = seed
        self._words = [_Words(self._stream("loss", sender), self._stream("latency", sender)) for sender in vehicles]
        concerns = ("duplication", "reordering", "corruption")
        self._rare = [tuple(self._stream(concern, sender) for concern in concerns) for sender in vehicles]
        self._in_bad_state: set[tuple[int, int]] = set()  # (sender, receiver) by number
        self.soonest = LATENCY.mean_s
        self.latest = LATENCY.mean_s
        """No copy has ever arrived sooner or later after it was sent, or will under these conditions, in seconds."""
        self.apply(NetworkConditions())

    def apply(self, conditions: NetworkConditions) -> None:
        """From now on broadcasts meet these conditions. Raises ConditionsError for an unknown vehicle."""
        conditions.validate(self._vehicles)
        group = {
            vehicle: index for index, members in enumerate(conditions.groups(self._vehicles)) for vehicle in members
        }
        self._group = [group[vehicle] for vehicle in self._vehicles]
        self._air = [self._air_of(number, sender, conditions) for number, sender in enumerate(self._vehicles)]
        self.soonest = min(self.soonest, *(air.soonest_of_all for air in self._air))
        self.latest = max(self.latest, *(air.latest for air in self._air))

    def hears(self, sender: int, receiver: int) -> bool:
        """Whether no partition stands between the two, by their numbers."""
        return self._group[sender] == self._group[receiver]

    def draw(self, sender: int) -> Lots:
        """The lots of the next broadcast of the sender with this number."""
        return self._air[sender].draw()

    def _air_of(self, number: int, sender: int, conditions: NetworkConditions) -> _Air:
        links = [conditions.link(sender, receiver) for receiver in self._vehicles]
        hears = [number != other and self.hears(number, other) for other in range(len(links))]
        if all(_is_plain(link) for link in set(links)):
            return _PlainAir(links, hears, self._words[number])
        return _AnyAir(number, links, hears, self._in_bad_state, self._words[number], self._rare[number])

    def _stream(self, concern: str, sender: int) -> Random:
        return Random(f"{self._seed}/{concern}/{sender}")


class _Air(Protocol):
    """Around one sender, under one set of conditions."""

    soonest_of_all: float
    latest: float

    def draw(self) -> Lots: ...


def _is_plain(link: LinkConditions) -> bool:
    """One lot each for loss and latency is all that it takes."""
    uniform = link.delay is None or link.delay.distribution == "uniform"
    return uniform and not (link.duplicate or link.reorder or link.corrupt or isinstance(link.loss, GilbertElliott))


class _PlainAir:
    """Independent loss and uniform latency: a word of 32 bits each for every receiver."""

    def __init__(self, links: list[LinkConditions], hears: list[bool], words: _Words) -> None:
        delays = [link.delay or LATENCY for link in links]
        self.receivers = len(links)
        self.hears = hears
        self.lost_below = [round(link.independent_loss * _WORD) for link in links]
        self.soonest = [delay.mean_s - delay.jitter_s for delay in delays]
        self.soonest_of_all = min(self.soonest)
        self.per_lot = [2 * delay.jitter_s / _WORD for delay in delays]
        self.latest = max(delay.mean_s + delay.jitter_s for delay in delays)
        self._words = words

    def draw(self) -> Lots:
        words = self._words
        at = words.next
        if at + self.receivers > len(words.loss):
            at = words.refill(self.receivers)
        words.next = at + self.receivers
        return _PlainLots(self, words.loss, words.latency, at, self.latest)


class _PlainLots:
    """Where the words of one broadcast stand among those of others."""

    __slots__ = ("_air", "_at", "_latency", "_loss", "latest")

    def __init__(self, air: _PlainAir, loss: array[int], latency: array[int], at: int, latest: float) -> None:
        self._air = air
        self._loss = loss
        self._latency = latency
        self._at = at
        self.latest = latest

    def copies_to(self, receiver: int) -> tuple[float, ...]:
        air = self._air
        word = self._at + receiver
        if self._loss[word] < air.lost_below[receiver] or not air.hears[receiver]:
            return ()
        return (air.soonest[receiver] + self._latency[word] * air.per_lot[receiver],)

    def to_all(self) -> list[tuple[int, float]]:
        air = self._air
        words = slice(self._at, self._at + air.receivers)
        loss, latency = self._loss[words], self._latency[words]
        each = zip(air.hears, loss, air.lost_below, air.soonest, latency, air.per_lot, strict=True)
        return [
            (receiver, soonest + word * per_lot)
            for receiver, (hears, lot, lost_below, soonest, word, per_lot) in enumerate(each)
            if lot >= lost_below and hears
        ]


class _Words:
    """Two streams of words of 32 bits, drawn many at a time and taken in step: those from `next` on are left."""

    def __init__(self, loss: Random, latency: Random) -> None:
        self.loss = array("I")
        self.latency = array("I")
        self._streams = loss, latency
        self.next = 0

    def take(self, count: int) -> int:
        """Where the next `count` words stand in `loss` and `latency` as they are then; these arrays do not change."""
        at = self.next
        if at + count > len(self.loss):
            at = self.refill(count)
        self.next = at + count
        return at

    def refill(self, count: int) -> int:
        """Draw words for many times `count`; where the next stand now."""
        loss, latency = self._streams
        self.loss = self.loss[self.next :] + _draw(loss, _BROADCASTS_AT_ONCE * count)
        self.latency = self.latency[self.next :] + _draw(latency, _BROADCASTS_AT_ONCE * count)
        return 0


def _draw(stream: Random, count: int) -> array[int]:
    words = array("I", stream.randbytes(4 * count))
    if sys.byteorder == "big":
        words.byteswap()
    return words


class _AnyAir:
    """All that conditions can ask. Every lot is drawn for every receiver, so that no one's lots depend on another's."""

    soonest_of_all = 0.0
    latest = inf

    def __init__(
        self,
        number: int,
        links: list[LinkConditions],
        hears: list[bool],
        in_bad_state: set[tuple[int, int]],
        words: _Words,
        rare: tuple[Random, ...],
    ) -> None:
        self._number = number
        self._links = links
        self._hears = hears
        self._in_bad_state = in_bad_state
        self._words = words
        self._duplication, self._reordering, self._corruption = rare

    def draw(self) -> Lots:
        delays = [self._delays(receiver, link) for receiver, link in enumerate(self._links)]
        return _DrawnLots([copies if hears else () for copies, hears in zip(delays, self._hears, strict=True)])

    def _delays(self, receiver: int, link: LinkConditions) -> tuple[float, ...]:
        words = self._words
        at = words.take(2)
        lost = self._is_lost(receiver, link.loss, words.loss[at] / _WORD, words.loss[at + 1] / _WORD)
        spoilt = self._corruption.random() < link.corrupt  # its receiver throws it away
        copies = 2 if self._duplication.random() < link.duplicate else 1
        overtakes = self._reordering.random() < link.reorder
        delay = link.delay or LATENCY
        first, second = sample(delay, words.latency[at] / _WORD), sample(delay, words.latency[at + 1] / _WORD)
        if lost or spoilt:
            return ()
        return (0.0 if overtakes else first, second)[:copies]

    def _is_lost(self, receiver: int, loss: float | GilbertElliott, lot: float, turn: float) -> bool:
        if not isinstance(loss, GilbertElliott):
            return lot < loss
        link = (self._number, receiver)
        bad = link in self._in_bad_state
        if bad and turn < loss.r:
            self._in_bad_state.discard(link)
        elif not bad and turn < loss.p:
            self._in_bad_state.add(link)
        return lot < (loss.loss_bad if bad else loss.loss_good)


@dataclass
class _DrawnLots:
    delays: list[tuple[float, ...]]

    def __post_init__(self) -> None:
        self.latest = max((delay for copies in self.delays for delay in copies), default=0.0)

    def copies_to(self, receiver: int) -> tuple[float, ...]:
        return self.delays[receiver]

    def to_all(self) -> list[tuple[int, float]]:
        return [(receiver, delay) for receiver, copies in enumerate(self.delays) for delay in copies]


def sample(delay: Delay, lot: float) -> float:
    """The delay in seconds that falls to `lot`, uniform in 0..1 (exclusive)."""
    if delay.distribution == "uniform":
        return delay.mean_s + delay.jitter_s * (2 * lot - 1)
    deviations = table(delay.distribution, _TABLE_SIZE)[int(lot * _TABLE_SIZE)] / SCALE
    return max(0.0, delay.mean_s + delay.jitter_s * deviations)
