"""Test that a scenario has the same meaning with real packets and in virtual time.

The simulated medium gets the real sending time of each packet, so the tests can compare effects of rates and limits
packet by packet. Other conditions are random both in the kernel and in the medium. The tests compare them as two random
samples. With a correct program, one of 100,000 checks fails.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, compress, pairwise
from pathlib import Path
from typing import get_args

import pytest

from netem.conditions import NetworkConditions
from netem.link import Delay, Distribution, GilbertElliott, LinkConditions
from netem.medium import Medium
from tests.netem.conftest import PACKETS, PORT, Air
from tests.netem.test_engine import in_lab
from tests.netem.test_links import HEADERS, LATE_S, until_quiet

pytestmark = pytest.mark.lab

WITNESS = (
    2  # receives each packet after a constant delay, which shows its sending time and the lateness of this machine
)
CONSTANT_S = 0.3
CONSTANT = LinkConditions(delay=Delay(CONSTANT_S))
DATA_BYTES = 1000
EARLY_S = 0.001  # maximum difference between the clocks that timestamp a packet
SEEDS = range(1, 6)


@dataclass
class PacketsAtReceiver:
    """The numbered packets that were sent, and their copies that a receiver received."""

    sent_at: list[float]
    """Sending time of each packet in seconds."""
    delays: list[list[float]]
    """Delays of the received copies of each packet in seconds. A lost packet has an empty list."""

    @property
    def came(self) -> list[bool]:
        return [bool(copies) for copies in self.delays]

    @property
    def all_delays(self) -> list[float]:
        return [delay for copies in self.delays for delay in copies]

    @property
    def arrivals(self) -> list[float]:
        """The arrival times of all copies, in the order of their packets."""
        return [at + delay for at, copies in zip(self.sent_at, self.delays, strict=True) for delay in copies]


@dataclass
class PacketsInBothNetworks:
    """The packets of one receiver in two networks: real packets, and simulated packets with several seeds."""

    kernel: PacketsAtReceiver
    medium: list[PacketsAtReceiver]
    late_s: float
    """Assumed delay of this machine in seconds: the largest measured delay, but at least LATE_S."""

    def agree_on_copies(self) -> None:
        """Check that the numbers of packets with no, one and two copies agree."""
        for number in range(3):
            kernel, medium = ([len(copies) == number for copies in one.delays] for one in self.sides)
            assert_same_share(f"{number} copies", kernel, medium)
        assert max(map(len, self.kernel.delays)) <= 2

    def agree_on_delays(self) -> None:
        """Check that the distributions of delays agree. Delays that this machine causes are allowed."""
        kernel, medium = (one.all_delays for one in self.sides)
        for at in statistics.quantiles(medium, n=20):
            by_then = [delay <= at for delay in medium]
            assert_no_more(f"sooner than {at:.3f} s", [delay <= at - EARLY_S for delay in kernel], by_then)
            assert_no_more(f"later than {at:.3f} s", by_then, [delay <= at + self.late_s for delay in kernel])

    @property
    def late_in_queue_s(self) -> float:
        """Return twice the delay of the machine, because a late packet also delays the packets behind it in a queue."""
        return 2 * self.late_s

    def agree_on_arrivals(self) -> None:
        """Check that packets which arrive in both cases arrive at the same time. Delays that this machine causes are
        allowed.
        """
        pairs = zip(self.kernel.delays, self.medium[0].delays, strict=True)
        later = statistics.quantiles(one[0] - other[0] for one, other in pairs if one and other)
        assert all(-EARLY_S < late_s < self.late_in_queue_s for late_s in later), later

    @property
    def sides(self) -> tuple[PacketsAtReceiver, PacketsAtReceiver]:
        return self.kernel, self.pooled

    @property
    def pooled(self) -> PacketsAtReceiver:
        """Return the packets of all seeds in virtual time."""
        sent_at = [at for one in self.medium for at in one.sent_at]
        return PacketsAtReceiver(sent_at, [copies for one in self.medium for copies in one.delays])


async def broadcast(
    air: Air, conditions: NetworkConditions, sender: int, receivers: Iterable[int], at_once: int = PACKETS
) -> dict[int, PacketsInBothNetworks]:
    """Send packets as fast as `sender` can, and return the packets at each receiver.

    `at_once` is the number of packets before each pause. With many receivers and no pauses, a kernel may drop packets.
    """
    receivers = sorted({WITNESS, *receivers})
    listeners = {vehicle: await air.start_ready(vehicle, "receive", PORT) for vehicle in receivers}
    for first in range(0, PACKETS, at_once):
        await air.broadcast(sender, min(at_once, PACKETS - first), first, DATA_BYTES)
    await until_quiet(air)
    found = {vehicle: await listener.finish() for vehicle, listener in listeners.items()}
    assert all(result["overflow"] == 0 for result in found.values()), "a receiver was too slow to judge by"
    witness = found[WITNESS]
    sent = zip(witness["numbers"], witness["at_s"], witness["delays_s"], strict=True)
    sent_s = {number: at_s - delay_s for number, at_s, delay_s in sent}
    assert len(sent_s) == PACKETS, "the machine was too slow to judge by: packets were lost that no condition loses"
    sent_at = [sent_s[number] - sent_s[0] for number in range(PACKETS)]
    in_kernel = {}
    for receiver in receivers:
        delays: list[list[float]] = [[] for _ in sent_at]
        for number, delay_s in zip(found[receiver]["numbers"], found[receiver]["delays_s"], strict=True):
            delays[number].append(delay_s)
        in_kernel[receiver] = PacketsAtReceiver(sent_at, delays)
    vehicles = air.lab.vehicles
    in_medium = [through_medium(vehicles, seed, conditions, vehicles.index(sender), sent_at) for seed in SEEDS]
    late_s = max(LATE_S, max(witness["delays_s"]) - CONSTANT_S)
    return {
        v: PacketsInBothNetworks(in_kernel[v], [flown[vehicles.index(v)] for flown in in_medium], late_s)
        for v in receivers
    }


def through_medium(
    vehicles: Sequence[int], seed: int, conditions: NetworkConditions, sender: int, sent_at: list[float]
) -> list[PacketsAtReceiver]:
    """Return the simulated packets at each vehicle. `sender` is an index in `vehicles`."""
    medium = Medium(vehicles, seed)
    medium.apply(conditions)
    flown = [PacketsAtReceiver(sent_at, [[] for _ in sent_at]) for _ in vehicles]
    for number, at in enumerate(sent_at):
        for receiver, delay in medium.draw(sender, at, DATA_BYTES).to_all():
            flown[receiver].delays[number].append(delay)
    return flown


def assert_no_more(what: str, one: Sequence[bool], other: Sequence[bool]) -> None:
    """Check that the share of true values in `one` is not larger than in `other`, except by chance."""
    share = (sum(one) + sum(other)) / (len(one) + len(other))
    width = 4.42 * math.sqrt(share * (1 - share) * (1 / len(one) + 1 / len(other)))
    more = sum(one) / len(one) - sum(other) / len(other)
    assert more <= width, f"{what}: {sum(one)} of {len(one)}, {sum(other)} of {len(other)}; allowed is {width:.3f} more"


def assert_same_share(what: str, one: Sequence[bool], other: Sequence[bool]) -> None:
    assert_no_more(what, one, other)
    assert_no_more(what, other, one)


def test_independent_draws_agree(netem: str, tmp_path: Path) -> None:
    """The conditions are loss together with duplicates, corruption, reordering, and delays of every distribution."""
    links = {
        WITNESS: CONSTANT,
        3: LinkConditions(loss=0.4, duplicate=0.6),
        4: LinkConditions(corrupt=0.2),
        5: LinkConditions(delay=Delay(0.3), reorder=0.25),
        6: LinkConditions(0.2, Delay(0.3, 0.1, "normal"), duplicate=0.5, reorder=0.2, corrupt=0.2),
        7: LinkConditions(delay=Delay(0.1, 0.1, "normal")),  # a sixth of the delays would be below 0
    }
    links |= {8 + i: LinkConditions(delay=Delay(0.5, 0.2, shape)) for i, shape in enumerate(get_args(Distribution))}
    conditions = NetworkConditions(receivers=links)

    async def story(air: Air) -> None:
        await air.lab.apply(conditions)
        found = await broadcast(air, conditions, 1, links, at_once=250)
        found[WITNESS].agree_on_arrivals()
        for receiver, both in found.items():
            both.agree_on_copies()
            if links[receiver].delay is not None:
                both.agree_on_delays()

    in_lab([1, *links], netem, tmp_path, story)


def test_bursts_and_directions_of_a_pair_agree(netem: str, tmp_path: Path) -> None:
    links = {
        WITNESS: CONSTANT,
        3: LinkConditions(GilbertElliott(0.05, 0.25)),
        4: LinkConditions(GilbertElliott(1, 1, loss_bad=0.9, loss_good=0.2)),  # good and bad states alternate
    }
    pairs = {(1, 5): LinkConditions(0.6), (5, 1): LinkConditions(0.2)}
    conditions = NetworkConditions(receivers=links, links=pairs)

    async def story(air: Air) -> None:
        await air.lab.apply(conditions)
        found = await broadcast(air, conditions, 1, [3, 4, 5])
        # Mean loss and mean length of bursts follow from how often losses begin, and how often they end.
        for before in (True, False):
            kernel, medium = ([now for last, now in pairwise(one.came) if last == before] for one in found[3].sides)
            assert_same_share(f"comes where the one before came: {before}", kernel, medium)
        for turn in (0, 1):
            kernel, medium = (one.came[turn::2] for one in found[4].sides)
            assert_same_share(f"comes by turn {turn}", kernel, medium)
        found[5].agree_on_copies()
        (await broadcast(air, conditions, 5, [1]))[1].agree_on_copies()

    in_lab(range(1, 6), netem, tmp_path, story)


def test_rates_and_limits_agree(netem: str, tmp_path: Path) -> None:
    each_s = 2.0 / PACKETS  # duration of a packet at the rate
    rate = (DATA_BYTES + HEADERS) * 8 / each_s
    limit = 40
    jitter = Delay(CONSTANT_S, 0.1, "normal")
    links = {
        WITNESS: CONSTANT,
        3: LinkConditions(rate=rate),
        4: LinkConditions(delay=Delay(CONSTANT_S), rate=rate),
        5: LinkConditions(rate=rate, corrupt=0.4),
        6: LinkConditions(delay=jitter, rate=rate),
        7: LinkConditions(delay=Delay(CONSTANT_S), rate=rate, reorder=0.25),
        8: LinkConditions(rate=rate, limit=limit),
        9: LinkConditions(delay=Delay(1.5), limit=limit),
    }
    conditions = NetworkConditions(receivers=links)

    async def story(air: Air) -> None:
        await air.lab.apply(conditions)
        found = await broadcast(air, conditions, 1, links)
        for receiver in (3, 4, 5, 8, 9):
            found[receiver].agree_on_arrivals()
        for receiver in (3, 4, 5, 6, 7):
            found[receiver].agree_on_copies()
        assert_jitter_keeps_order(found[6], 3 * jitter.jitter_s)
        assert_overtakers_take_no_time(found[7], each_s)
        passed = [list(accumulate(one.came)) for one in (found[8].kernel, found[8].medium[0])]
        at_once = 1 + found[8].late_in_queue_s / each_s
        assert max(abs(one - other) for one, other in zip(*passed, strict=True)) <= at_once
        before_one_left = [at < 1.5 for at in found[9].kernel.sent_at]
        for one in (found[9].kernel, found[9].medium[0]):
            assert list(compress(one.came, before_one_left)) == [n < limit for n in range(sum(before_one_left))]

    in_lab([1, *links], netem, tmp_path, story)


def assert_jitter_keeps_order(both: PacketsInBothNetworks, spread_s: float) -> None:
    """Check that, with a limited data rate, random delays neither change the order of packets nor add up."""
    heard = [one.arrivals for one in (both.kernel, *both.medium)]
    assert all(map(in_order, heard))
    ends = [arrivals[-1] for arrivals in heard]
    assert max(ends) - min(ends) < spread_s, ends


def assert_overtakers_take_no_time(both: PacketsInBothNetworks, each_s: float) -> None:
    """Check that, with a limited data rate, reordered packets are not delayed and the other packets keep their
    order.
    """
    assert_same_share("overtakes", *([delay < CONSTANT_S / 2 for delay in one.all_delays] for one in both.sides))
    for one in (both.kernel, *both.medium):
        copies = zip(one.sent_at, one.arrivals, strict=True)
        others = [(sent_at, at) for sent_at, at in copies if at - sent_at > CONSTANT_S / 2]
        assert in_order([at for _, at in others])
        leaves_at = 0.0
        for sent_at, _ in others:
            leaves_at = max(leaves_at, sent_at + CONSTANT_S) + each_s
        assert others[-1][1] == pytest.approx(leaves_at, abs=both.late_in_queue_s)


def in_order(arrivals: list[float]) -> bool:
    """Return whether the arrival times are in order, within the accuracy of the clocks."""
    return all(later > before - EARLY_S for before, later in pairwise(arrivals))
