"""What a receiver heard of a stream of packets, as figures with their 99.9 % intervals.

Shares have Wilson's interval, means and deviations the normal one. What is lost in bursts is not drawn packet by
packet: a stream is then worth as many independent packets as its correlation leaves. Rate and limit are not drawn at
all: their intervals are what the times of arrival leave open.

Every time contains how late the machine is by itself, in two ways. *On the way*: from the sender's stamp to the
receiver's, a packet that nothing holds up takes a while. A receiver without conditions hears the same packets at the
same time, so its times are subtracted, packet by packet. *Timers*: a packet that waits leaves when a timer of the
kernel expires, which is late too. The sender sleeps between its packets and notes how late it wakes. Nobody can tell
that from a delay, so the intervals of delays reach so much lower, by the upper bound of what was noted. On a slow
machine intervals are wide; a kernel is not found wrong there.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from statistics import NormalDist, fmean, median, variance

CONFIDENCE = 0.999
_Z = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)


@dataclass(frozen=True)
class Estimate:
    """A figure, the bounds of its 99.9 % interval, and how many packets it was taken from; of none, all 0."""

    measured: float
    low: float
    high: float
    packets: int


@dataclass(frozen=True)
class Lateness:
    """How late the machine is by itself, in seconds: each packet of a stream on the way, and each of many timers."""

    way_s: Sequence[float]
    timers_s: Sequence[float]


@dataclass(frozen=True)
class Heard:
    """What one receiver heard of one sender's packets, which are numbered from 0.

    `sent_s` says when each was sent; `arrivals` are (number, time), ascending in time, of every copy that came.
    """

    sent_s: Sequence[float]
    arrivals: Sequence[tuple[int, float]]
    lateness: Lateness


_NOTHING = Estimate(0.0, 0.0, 0.0, 0)


def lost(heard: Heard) -> Estimate:
    """The share of packets that never came, each drawn on its own."""
    return share(sum(_losses(heard)), len(heard.sent_s))


def lost_in_bursts(heard: Heard) -> Estimate:
    """The share of packets that never came, where losses come as a Markov chain of two states has them."""
    losses = _losses(heard)
    return share(sum(losses), len(losses), worth=_independence(losses))


def burst_length(heard: Heard) -> Estimate:
    """How many packets in a row are lost, on average; a burst that goes on at the end of the stream does not count."""
    runs = [(gone, sum(1 for _ in run)) for gone, run in groupby(_losses(heard))]
    lengths = [length for gone, length in runs[:-1] if gone]
    return mean(lengths, packets=len(heard.sent_s))


def passed(heard: Heard) -> Estimate:
    """The share of packets that came."""
    return share(len(heard.sent_s) - sum(_losses(heard)), len(heard.sent_s))


def came_twice(heard: Heard) -> Estimate:
    """The share of packets that came twice."""
    copies = Counter(number for number, _ in heard.arrivals)
    return share(sum(count > 1 for count in copies.values()), len(heard.sent_s))


def came_at_once(heard: Heard, delay_s: float) -> Estimate:
    """Of the packets that came, the share that took less than half the delay."""
    sent_s = heard.sent_s
    return share(sum(at_s - sent_s[number] < delay_s / 2 for number, at_s in heard.arrivals), len(heard.arrivals))


def delay_mean(heard: Heard) -> Estimate:
    """Seconds, without what packets take on the way by themselves."""
    estimate = mean(_delays(heard))
    timers = mean(heard.lateness.timers_s)
    return Estimate(estimate.measured, estimate.low - max(0.0, timers.high), estimate.high, estimate.packets)


def delay_deviation(heard: Heard) -> Estimate:
    """The standard deviation in seconds, of which the machine may have added its own."""
    estimate = deviation(_delays(heard))
    own = sum(deviation(late_s).high ** 2 for late_s in (heard.lateness.way_s, heard.lateness.timers_s))
    low = math.sqrt(max(0.0, estimate.low**2 - own))
    return Estimate(estimate.measured, low, estimate.high, estimate.packets)


def rate(heard: Heard, packet_bits: int) -> Estimate:
    """Bits per second, over the longest run of packets that each came when the one before had not yet left.

    The ends of the run may be as late as the latest of all.
    """
    run: list[float] = []
    longest: list[float] = []
    for number, at_s in heard.arrivals:
        if run and heard.sent_s[number] >= run[-1]:
            run = []
        run.append(at_s)
        longest = max(longest, run, key=len)
    if len(longest) < 2:
        return _NOTHING
    bits, took_s = packet_bits * (len(longest) - 1), longest[-1] - longest[0]
    late_s = max(heard.lateness.way_s) + max(heard.lateness.timers_s)
    return Estimate(bits / took_s, bits / (took_s + late_s), bits / max(took_s - late_s, 1e-9), len(longest))


def waiting_when_lost(heard: Heard, delay_s: float) -> Estimate:
    """How many packets waited for their delay when one was lost: a limit.

    For each packet lost there are those that must still have waited, as their delay was not over, and those that may
    have, as they had not come yet. The medians of both are the bounds.
    """
    came = dict(heard.arrivals)
    must: list[int] = []
    may: list[int] = []
    waiting: list[int] = []
    for number, sent_s in enumerate(heard.sent_s):
        waiting = [earlier for earlier in waiting if came[earlier] > sent_s]
        if number in came:
            waiting.append(number)
        else:
            may.append(len(waiting))
            must.append(sum(sent_s < heard.sent_s[earlier] + delay_s for earlier in waiting))
    if not must:
        return _NOTHING
    low, high = median(must), median(may)
    return Estimate((low + high) / 2, low, high, len(heard.sent_s))


def share(hits: int, count: int, worth: float = 1.0) -> Estimate:
    """The share that `hits` are of `count` draws, each of which is worth so many independent ones (Wilson, 1927)."""
    if count == 0:
        return _NOTHING
    ratio, draws = hits / count, count * worth
    centre = (ratio + _Z**2 / (2 * draws)) / (1 + _Z**2 / draws)
    margin = _Z / (1 + _Z**2 / draws) * math.sqrt(ratio * (1 - ratio) / draws + (_Z / (2 * draws)) ** 2)
    low, high = max(0.0, centre - margin), min(1.0, centre + margin)
    return Estimate(ratio, 0.0 if hits == 0 else low, 1.0 if hits == count else high, count)


def mean(values: Sequence[float], *, packets: int | None = None) -> Estimate:
    """The mean of independent values, which were taken from so many `packets` (None: one each)."""
    if len(values) < 2:
        return _NOTHING
    average, margin = fmean(values), _Z * math.sqrt(variance(values) / len(values))
    return Estimate(average, average - margin, average + margin, len(values) if packets is None else packets)


def deviation(values: Sequence[float]) -> Estimate:
    """The standard deviation of independent values of any shape: that of a mean of squares."""
    if len(values) < 2:
        return _NOTHING
    middle = fmean(values)
    squares = mean([(value - middle) ** 2 for value in values])
    low, high = (math.sqrt(max(0.0, bound)) for bound in (squares.low, squares.high))
    return Estimate(math.sqrt(squares.measured), low, high, len(values))


def _losses(heard: Heard) -> list[bool]:
    came = {number for number, _ in heard.arrivals}
    return [number not in came for number in range(len(heard.sent_s))]


def _independence(losses: Sequence[bool]) -> float:
    """How many independent draws one of a chain is worth for its mean: (1 - c) / (1 + c), c from one to the next."""
    loss = fmean(losses)
    if not 0 < loss < 1:
        return 1.0
    both = fmean(earlier and later for earlier, later in pairwise(losses))
    correlation = min(max(0.0, (both - loss**2) / (loss * (1 - loss))), 0.999)
    return (1 - correlation) / (1 + correlation)


def _delays(heard: Heard) -> list[float]:
    sent_s, way_s = heard.sent_s, heard.lateness.way_s
    return [at_s - sent_s[number] - way_s[number] for number, at_s in heard.arrivals]
