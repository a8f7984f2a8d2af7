"""Estimate properties of a received stream of packets, with 99.9 % confidence intervals.

Shares have Wilson intervals. Means and deviations have intervals of the normal distribution. Losses in bursts are not
independent, so a stream with such losses counts as a smaller number of independent packets. The number depends on the
correlation of the losses. Rate and limit are not random. Their intervals contain all values that are consistent with
the arrival times.

Each measured time also contains delays of the machine, which have two causes:

- *Transit*: even on a perfect link, a packet takes some time from the sender to the receiver. A reference vehicle with
  perfect links receives the same packets. The time of each packet to the reference vehicle is subtracted from its
  measured delay.
- *Timers*: a delayed packet leaves when a timer of the kernel expires, and timers expire late. The sender sleeps
  between its packets, and records how late it wakes up. A measurement cannot separate the lateness of a timer from a
  delay, so the upper limit of the recorded lateness is subtracted from the lower limit of a delay.

On a slow machine the intervals become wide, but a correct kernel is never reported as wrong.
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
    """An estimate with its 99.9 % confidence interval and its number of packets. Without packets, all values are 0."""

    measured: float
    low: float
    high: float
    packets: int


@dataclass(frozen=True)
class MachineLateness:
    """Delays of the machine itself in seconds: of packets in transit, and of timers."""

    way_s: Sequence[float]
    timers_s: Sequence[float]


@dataclass(frozen=True)
class ReceivedStream:
    """The packets of one sender that arrived at one receiver. The packets are numbered from 0.

    `sent_s` contains the sending times. `arrivals` contains, for each received copy in order of time, the number of the
    packet and the time of arrival.
    """

    sent_s: Sequence[float]
    arrivals: Sequence[tuple[int, float]]
    lateness: MachineLateness


_NOTHING = Estimate(0.0, 0.0, 0.0, 0)


def lost(received: ReceivedStream) -> Estimate:
    """Estimate the share of lost packets. Assume that losses are independent."""
    return share(sum(_losses(received)), len(received.sent_s))


def lost_in_bursts(received: ReceivedStream) -> Estimate:
    """Estimate the share of lost packets. Assume that losses follow a Markov chain with two states."""
    losses = _losses(received)
    return share(sum(losses), len(losses), worth=_independence(losses))


def burst_length(received: ReceivedStream) -> Estimate:
    """Return the mean number of successive lost packets. A series of losses at the end of the stream does not count."""
    runs = [(gone, sum(1 for _ in run)) for gone, run in groupby(_losses(received))]
    lengths = [length for gone, length in runs[:-1] if gone]
    return mean(lengths, packets=len(received.sent_s))


def passed(received: ReceivedStream) -> Estimate:
    """Return the share of received packets."""
    return share(len(received.sent_s) - sum(_losses(received)), len(received.sent_s))


def duplicated(received: ReceivedStream) -> Estimate:
    """Return the share of packets that arrived twice."""
    copies = Counter(number for number, _ in received.arrivals)
    return share(sum(count > 1 for count in copies.values()), len(received.sent_s))


def undelayed(received: ReceivedStream, delay_s: float) -> Estimate:
    """Return the share of received packets whose delay was less than half of `delay_s`."""
    sent_s = received.sent_s
    return share(sum(at_s - sent_s[number] < delay_s / 2 for number, at_s in received.arrivals), len(received.arrivals))


def delay_mean(received: ReceivedStream) -> Estimate:
    """Return the mean delay in seconds, without the time that packets take on an undelayed link."""
    estimate = mean(_delays(received))
    timers = mean(received.lateness.timers_s)
    return Estimate(estimate.measured, estimate.low - max(0.0, timers.high), estimate.high, estimate.packets)


def delay_deviation(received: ReceivedStream) -> Estimate:
    """Return the standard deviation of the delay in seconds. The interval accounts for the machine's own deviation."""
    estimate = deviation(_delays(received))
    own = sum(deviation(late_s).high ** 2 for late_s in (received.lateness.way_s, received.lateness.timers_s))
    low = math.sqrt(max(0.0, estimate.low**2 - own))
    return Estimate(estimate.measured, low, estimate.high, estimate.packets)


def rate(received: ReceivedStream, packet_bits: int) -> Estimate:
    """Return the data rate in bits per second, from the longest series of packets that arrived without a pause.

    The first and the last packet of the series may be as late as the latest packet of the stream. The limits of the
    confidence interval take this lateness into account.
    """
    run: list[float] = []
    longest: list[float] = []
    for number, at_s in received.arrivals:
        if run and received.sent_s[number] >= run[-1]:
            run = []
        run.append(at_s)
        longest = max(longest, run, key=len)
    if len(longest) < 2:
        return _NOTHING
    bits, took_s = packet_bits * (len(longest) - 1), longest[-1] - longest[0]
    late_s = max(received.lateness.way_s) + max(received.lateness.timers_s)
    return Estimate(bits / took_s, bits / (took_s + late_s), bits / max(took_s - late_s, 1e-9), len(longest))


def waiting_when_lost(received: ReceivedStream, delay_s: float) -> Estimate:
    """Estimate the limit of the delay queue: the number of packets in the queue at the time when a further packet is
    lost.

    For each lost packet, the function computes a lower and an upper bound of this number. Packets whose delay is not
    over are certainly in the queue. Packets that have not arrived yet may be in the queue. The limits of the estimate
    are the medians of the lower and of the upper bounds.
    """
    received_packets = dict(received.arrivals)
    must: list[int] = []
    may: list[int] = []
    waiting: list[int] = []
    for number, sent_s in enumerate(received.sent_s):
        waiting = [earlier for earlier in waiting if received_packets[earlier] > sent_s]
        if number in received_packets:
            waiting.append(number)
        else:
            may.append(len(waiting))
            must.append(sum(sent_s < received.sent_s[earlier] + delay_s for earlier in waiting))
    if not must:
        return _NOTHING
    low, high = median(must), median(may)
    return Estimate((low + high) / 2, low, high, len(received.sent_s))


def share(hits: int, count: int, worth: float = 1.0) -> Estimate:
    """Estimate the probability of an event that occurred in `hits` of `count` draws (Wilson, 1927). `worth` is the
    number of independent draws to which one draw is equivalent. It is below 1 if the draws are correlated.
    """
    if count == 0:
        return _NOTHING
    ratio, draws = hits / count, count * worth
    centre = (ratio + _Z**2 / (2 * draws)) / (1 + _Z**2 / draws)
    margin = _Z / (1 + _Z**2 / draws) * math.sqrt(ratio * (1 - ratio) / draws + (_Z / (2 * draws)) ** 2)
    low, high = max(0.0, centre - margin), min(1.0, centre + margin)
    return Estimate(ratio, 0.0 if hits == 0 else low, 1.0 if hits == count else high, count)


def mean(values: Sequence[float], *, packets: int | None = None) -> Estimate:
    """Estimate the mean of independent values. `packets` is the number of packets from which the values were computed.
    By default, each value comes from one packet.
    """
    if len(values) < 2:
        return _NOTHING
    average, margin = fmean(values), _Z * math.sqrt(variance(values) / len(values))
    return Estimate(average, average - margin, average + margin, len(values) if packets is None else packets)


def deviation(values: Sequence[float]) -> Estimate:
    """Estimate the standard deviation of independent values. The estimate assumes no particular distribution."""
    if len(values) < 2:
        return _NOTHING
    middle = fmean(values)
    squares = mean([(value - middle) ** 2 for value in values])
    low, high = (math.sqrt(max(0.0, bound)) for bound in (squares.low, squares.high))
    return Estimate(math.sqrt(squares.measured), low, high, len(values))


def _losses(received: ReceivedStream) -> list[bool]:
    received_packets = {number for number, _ in received.arrivals}
    return [number not in received_packets for number in range(len(received.sent_s))]


def _independence(losses: Sequence[bool]) -> float:
    """Return the number of independent draws to which one draw of this sequence is equivalent. It is below 1 for losses
    in bursts, because they are correlated. It is (1 - c) / (1 + c), where c is the correlation of successive losses.
    """
    loss = fmean(losses)
    if not 0 < loss < 1:
        return 1.0
    both = fmean(earlier and later for earlier, later in pairwise(losses))
    correlation = min(max(0.0, (both - loss**2) / (loss * (1 - loss))), 0.999)
    return (1 - correlation) / (1 + correlation)


def _delays(received: ReceivedStream) -> list[float]:
    sent_s, way_s = received.sent_s, received.lateness.way_s
    return [at_s - sent_s[number] - way_s[number] for number, at_s in received.arrivals]
