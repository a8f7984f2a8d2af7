"""Compare the simulated radio channel with a formula for stations that always have a frame to send.

Bianchi (Performance Analysis of the IEEE 802.11 Distributed Coordination Function, IEEE Journal on Selected Areas in
Communications 18(3), 2000) assumes that stations in range of each other send independently of each other in each slot,
and counts slots between transmissions. A broadcast is never repeated, so the window stays at W = CW + 1 slots.

Foh and Tantra (Comments on IEEE 802.11 Saturation Throughput Analysis with Freezing of Backoff Counters, IEEE
Communications Letters 9(2), 2005) add that a counter freezes while the channel is busy. Only the stations that have
just sent can draw 0 and send in the first slot after a busy time. A station draws 0 with probability 1 / W. Otherwise,
it sends after an idle slot. It draws (W - 1) / 2 on average and thus sends after an idle slot with probability 2 / W.

The tests compare the share of frames that collide, and the frames per second that arrive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby, pairwise

import pytest

from netem.channel import PRESETS, Channel, EndedTransmission, WifiRadio

pytestmark = pytest.mark.any_user

DATA_BYTES = 100
FRAMES = 15_000
SIGMAS = 4.0
"""Maximum difference between the model and the formula in standard errors. One of 16,000 seeds would exceed it."""


def alone_and_busy(n: int, window: int) -> tuple[float, float, float]:
    """Return three expected numbers for each slot that follows an idle slot.

    They are the number of frames that are sent alone, the number of busy times, and the number of all frames.
    """
    again = 1 / window
    alone, busy = [0.0], [0.0]  # in the busy times that follow one with this number of senders
    for senders in range(1, n + 1):
        odds = [binomial(senders, again, sending) for sending in range(1, senders + 1)]
        known = 1 - odds[-1]
        alone.append((odds[0] + sum(p * a for p, a in zip(odds, alone[1:], strict=False))) / known)
        busy.append((sum(odds) + sum(p * b for p, b in zip(odds, busy[1:], strict=False))) / known)
    first = [binomial(n, 2 / window, senders) for senders in range(1, n + 1)]
    return (
        first[0] + sum(p * a for p, a in zip(first, alone[1:], strict=True)),
        sum(first) + sum(p * b for p, b in zip(first, busy[1:], strict=True)),
        n * 2 / (window - 1),
    )


def binomial(n: int, p: float, k: int) -> float:
    return math.comb(n, k) * p**k * (1 - p) ** (n - k)


def saturated(radio: WifiRadio, n: int) -> list[tuple[float, int]]:
    """Simulate stations that always have a frame to send.

    Return, for each busy time, the seconds until the next busy time, and the number of stations that sent.
    """
    channel = Channel(range(1, n + 1), radio, seed=1)
    for station in range(n):
        channel.send(station, 0.0, DATA_BYTES)
        channel.send(station, 0.0, DATA_BYTES)
    sent: list[EndedTransmission] = []
    while len(sent) < FRAMES:
        now = channel.next_event()
        assert now is not None
        for transmission in channel.advance(now):
            sent.append(transmission)
            channel.send(transmission.sender, now, DATA_BYTES)
    starts = [(begins, list(frames)) for begins, frames in groupby(sent, lambda transmission: transmission.began_at)]
    for _, frames in starts:
        assert all((transmission.received != 0) == (len(frames) == 1) for transmission in frames)
    return [(after - before, len(frames)) for (before, frames), (after, _) in pairwise(starts)]


def ratio(parts: Sequence[float], wholes: Sequence[float]) -> tuple[float, float]:
    """Return the sum of the parts divided by the sum of the wholes, and the standard error of this ratio."""
    found = sum(parts) / sum(wholes)
    squares = sum((part - found * whole) ** 2 for part, whole in zip(parts, wholes, strict=True))
    return found, math.sqrt(squares) / sum(wholes)


@pytest.mark.parametrize(("preset", "n"), [("wifi_1", 5), ("wifi_1", 20), ("wifi_6", 2), ("wifi_6", 5), ("wifi_6", 20)])
def test_saturated_stations_collide_as_often_as_the_closed_form(preset: str, n: int) -> None:
    radio = PRESETS[preset]
    assert isinstance(radio, WifiRadio)
    radio = replace(radio, shadowing_db=0.0)
    alone, busy, frames = alone_and_busy(n, radio.contention_window + 1)
    found = saturated(radio, n)
    senders = [count for _, count in found]

    collided, error = ratio([count if count > 1 else 0 for count in senders], senders)
    assert collided == pytest.approx(1 - alone / frames, abs=SIGMAS * error)

    period_s = radio.slot_s + busy * (radio.airtime_ns(DATA_BYTES) / 1e9 + radio.difs_s)
    per_second, error = ratio([count == 1 for count in senders], [seconds for seconds, _ in found])
    assert per_second == pytest.approx(alone / period_s, abs=SIGMAS * error)
