"""Test the simulated network: count the effects on many broadcasts with a fixed seed."""

from collections import Counter
from itertools import pairwise
from statistics import fmean, stdev
from typing import Any

import pytest

from netem.conditions import Delay, GilbertElliott, LinkConditions, NetworkConditions
from netem.errors import ConditionsError
from netem.medium import Medium, RandomDraws

BROADCASTS = 20_000
DATA_BYTES = 83  # makes a frame of 1000 bits
CONSTANT = LinkConditions(delay=Delay(1.5))


def medium(vehicles: int = 3, seed: int = 1, *, conditions: NetworkConditions | None = None, **link: Any) -> Medium:
    air = Medium(range(1, vehicles + 1), seed)
    air.apply(conditions or NetworkConditions(LinkConditions(**link)))
    return air


def draw(air: Medium, sender: int, now: float = 0.0) -> RandomDraws:
    return air.draw(sender, now, DATA_BYTES)


def delays(air: Medium, sender: int, receiver: int, broadcasts: int = BROADCASTS) -> list[list[float]]:
    """Return the delays of the copies at one receiver, for each broadcast of one sender."""
    return [[delay for number, delay in draw(air, sender).to_all() if number == receiver] for _ in range(broadcasts)]


def lost(copies: list[list[float]]) -> float:
    return sum(not one for one in copies) / len(copies)


@pytest.mark.parametrize("loss", [0.0, 0.15, 0.5, 1.0])
def test_each_receiver_loses_the_requested_share_independently(loss: float) -> None:
    air = medium(loss=loss)
    heard = Counter(number for _ in range(BROADCASTS) for number, _ in draw(air, 0).to_all())
    assert [1 - heard[number] / BROADCASTS for number in (1, 2)] == [pytest.approx(loss, abs=0.012)] * 2
    both = sum(len(draw(air, 0).to_all()) == 2 for _ in range(BROADCASTS)) / BROADCASTS
    assert both == pytest.approx((1 - loss) ** 2, abs=0.012)
    assert heard[0] == 0  # a sender does not receive its own broadcast


def test_bursts_have_the_mean_and_length_of_their_model() -> None:
    bursts = GilbertElliott(p=0.05, r=0.25)
    copies = delays(medium(loss=bursts), 0, 1, 40_000)
    assert lost(copies) == pytest.approx(bursts.mean, abs=0.01)
    runs = "".join("x" if not one else "." for one in copies).replace(".", " ").split()
    assert fmean(map(len, runs)) == pytest.approx(1 / 0.25, rel=0.05)


def test_default_delay_is_uniform_between_2_and_50_ms() -> None:
    taken = [delay for copies in delays(medium(), 0, 1) for delay in copies]
    assert 0.002 <= min(taken) < 0.003
    assert 0.049 < max(taken) <= 0.05
    assert fmean(taken) == pytest.approx(0.026, abs=0.0005)
    assert stdev(taken) == pytest.approx(0.048 / 12**0.5, rel=0.02)


@pytest.mark.parametrize("distribution", ["uniform", "normal", "pareto", "paretonormal"])
def test_delay_has_its_mean_and_jitter(distribution: str) -> None:
    asked = Delay(0.5, 0.1, distribution)  # type: ignore[arg-type]
    taken = [delay for copies in delays(medium(delay=asked), 0, 1) for delay in copies]
    assert fmean(taken) == pytest.approx(0.5, abs=0.01)
    if distribution == "uniform":
        assert 0.4 <= min(taken) < 0.401 < 0.599 < max(taken) <= 0.6
    else:
        assert stdev(taken) == pytest.approx(0.1, rel=0.2)
    if distribution == "pareto":
        assert max(taken) - 0.5 > 3 * (0.5 - min(taken))  # a long tail, on one side


def test_no_delay_is_negative() -> None:
    taken = [delay for copies in delays(medium(delay=Delay(0.1, 0.1, "normal")), 0, 1) for delay in copies]
    assert sum(delay == 0.0 for delay in taken) / len(taken) == pytest.approx(0.159, abs=0.012)
    assert min(taken) == 0.0


@pytest.mark.parametrize(("loss", "duplicate"), [(0.2, 0.1), (0.4, 0.6), (1.0, 0.3)])
def test_lost_packet_with_a_duplicate_leaves_one_copy(loss: float, duplicate: float) -> None:
    copies = Counter(map(len, delays(medium(loss=loss, duplicate=duplicate), 0, 1)))
    expected = [
        loss * (1 - duplicate),
        (1 - loss) * (1 - duplicate) + loss * duplicate + (1 - loss) * duplicate * loss,
        (1 - loss) * duplicate * (1 - loss),
    ]
    assert [copies[number] / BROADCASTS for number in range(3)] == [pytest.approx(one, abs=0.012) for one in expected]


def test_reordered_packets_arrive_at_once_and_copies_have_own_delays() -> None:
    copies = delays(medium(delay=Delay(1.0, 0.5), duplicate=0.3, reorder=0.25), 0, 1)
    each = [delay for one in copies for delay in one]
    assert sum(delay == 0.0 for delay in each) / len(each) == pytest.approx(0.25, abs=0.012)
    twice = [one for one in copies if len(one) == 2]
    assert sum(min(one) == 0.0 for one in twice) / len(twice) == pytest.approx(1 - 0.75**2, abs=0.03)
    assert sum(one[0] == one[1] for one in twice) / len(twice) == pytest.approx(0.25**2, abs=0.02)


def arrivals(air: Medium, sent_at: list[float], receiver: int = 1) -> list[list[float]]:
    """Return the arrival times of the copies, for each broadcast of the first vehicle."""
    return [[at + delay for delay in draw(air, 0, at).copies_to(receiver)] for at in sent_at]


def test_packet_on_a_rate_leaves_after_earlier_ones() -> None:
    """A frame of 1000 bits takes one second at 1000 bit/s."""
    assert arrivals(medium(rate=1000), [0.0, 0.25, 0.5, 5.0]) == [[1.0], [2.0], [3.0], [6.0]]
    # A packet waits for the rate after its delay and after earlier packets. The queue is empty again at 8.
    air = medium(rate=1000, delay=Delay(2.0))
    assert arrivals(air, [0.0, 0.25, 0.5, 4.75, 9.0]) == [[3.0], [4.0], [5.0], [7.75], [12.0]]
    # Each frame has 42 bytes of headers.
    assert medium(rate=8).draw(0, 0.0, 0).copies_to(1) == (42.0,)


def test_each_directed_pair_has_its_own_queue() -> None:
    air = medium(conditions=NetworkConditions(links={(1, 2): LinkConditions(rate=1000), (2, 1): CONSTANT}))
    assert arrivals(air, [0.0, 0.0]) == [[1.0], [2.0]]
    assert draw(air, 1).copies_to(0) == (1.5,)
    assert arrivals(air, [0.0]) == [[3.0]]


def test_jitter_reorders_only_without_a_rate() -> None:
    sent_at = [index / 100 for index in range(500)]
    jitter = Delay(1.0, 1.0, "normal")
    free = [at for (at,) in arrivals(medium(delay=jitter), sent_at)]
    ordered = [at for (at,) in arrivals(medium(delay=jitter, rate=1e6), sent_at)]
    assert free != sorted(free)
    assert all(later - before >= 0.000999 for before, later in pairwise(ordered))


def test_packet_beyond_the_limit_is_lost() -> None:
    air = medium(rate=1000, limit=2)
    # The first packet leaves at 1. At this time, the queue accepts a packet again.
    assert arrivals(air, [0.0, 0.0, 0.5, 1.0, 1.5, 2.0]) == [[1.0], [2.0], [], [3.0], [], [4.0]]
    air = medium(delay=Delay(1.5), limit=3)
    assert arrivals(air, [0.0, 0.25, 0.5, 1.0, 1.5, 1.5]) == [[1.5], [1.75], [2.0], [], [3.0], []]


def test_reordered_packet_takes_no_place_in_the_queue() -> None:
    air = medium(rate=1000, delay=Delay(2.0), reorder=1.0, limit=1)
    assert arrivals(air, [0.0, 0.0, 0.5]) == [[0.0], [0.0], [0.5]]


def test_corrupted_packet_takes_a_place_and_a_lost_one_does_not() -> None:
    found = arrivals(medium(rate=1000, corrupt=0.5), [0.0] * 100)
    assert 20 < sum(map(len, found)) < 80
    assert all(copies in ([], [at]) for at, copies in enumerate(found, 1))
    heard = [at for copies in arrivals(medium(rate=1000, loss=0.5), [0.0] * 100) for at in copies]
    assert heard == list(range(1, len(heard) + 1))


def test_second_copy_leaves_the_queue_before_the_first() -> None:
    """A packet with two copies needs only one free place in the queue when it arrives. Afterwards it occupies two
    places.
    """
    assert arrivals(medium(rate=1000, duplicate=1.0), [0.0, 0.0]) == [[2.0, 1.0], [4.0, 3.0]]
    one_waits = medium(rate=1000, duplicate=1.0, limit=1)
    assert arrivals(one_waits, [0.0, 0.0, 1.5, 2.0]) == [[2.0, 1.0], [], [], [4.0, 3.0]]


def test_queue_survives_a_change_between_conditions_with_memory() -> None:
    air = medium(rate=1000)
    assert arrivals(air, [0.0, 0.0]) == [[1.0], [2.0]]
    air.apply(NetworkConditions(LinkConditions(rate=2000, limit=3)))
    assert arrivals(air, [0.5, 0.5]) == [[2.5], []]
    air.apply(NetworkConditions(LinkConditions(delay=Delay(0.25), limit=3)))
    assert arrivals(air, [0.5, 1.0, 1.0]) == [[], [1.25], []]
    air.apply(NetworkConditions(LinkConditions(rate=1000)))
    assert arrivals(air, [1.0]) == [[3.5]]
    for forgetful in (CONSTANT, LinkConditions(delay=Delay(1.5, 0.0, "normal"))):
        air.apply(NetworkConditions(forgetful))
        assert arrivals(air, [1.0]) == [[2.5]]
        air.apply(NetworkConditions(LinkConditions(rate=1000)))
        assert arrivals(air, [1.0]) == [[2.0]]


def test_partition_drops_packets_before_the_queue() -> None:
    air = medium(rate=1000)
    open_ = NetworkConditions(LinkConditions(rate=1000))
    assert arrivals(air, [0.0]) == [[1.0]]
    air.apply(open_.with_partition([[1]]))
    assert arrivals(air, [0.0, 0.0]) == [[], []]
    air.apply(open_)
    assert arrivals(air, [0.0]) == [[2.0]]


def test_bursts_restart_at_new_conditions_but_not_at_a_partition() -> None:
    bursts = NetworkConditions(LinkConditions(GilbertElliott(1, 0)))  # good for one packet, and then bad forever
    air = medium(conditions=bursts)
    heard = [bool(draw(air, 0).copies_to(1)) for _ in range(2)]
    air.apply(bursts.with_partition([[3]]))
    heard.append(bool(draw(air, 0).copies_to(1)))
    air.apply(NetworkConditions(LinkConditions(GilbertElliott(1, 0), Delay(1.0))))
    heard.append(bool(draw(air, 0).copies_to(1)))
    assert heard == [True, False, False, True]


def test_corruption_adds_to_the_loss() -> None:
    assert lost(delays(medium(corrupt=0.2), 0, 1)) == pytest.approx(0.2, abs=0.012)
    assert lost(delays(medium(corrupt=0.2, loss=0.5), 0, 1)) == pytest.approx(0.6, abs=0.012)


def test_conditions_of_receivers_and_links_have_one_direction() -> None:
    air = medium(
        conditions=NetworkConditions(
            receivers={2: LinkConditions(loss=0.5)}, links={(3, 1): LinkConditions(loss=1.0, delay=Delay(1.0))}
        )
    )
    assert lost(delays(air, 0, 1)) == pytest.approx(0.5, abs=0.012)
    assert lost(delays(air, 0, 2)) == 0.0
    assert lost(delays(air, 2, 0, 100)) == 1.0
    assert lost(delays(air, 1, 0, 100)) == 0.0


def test_nothing_crosses_a_partition_until_it_heals() -> None:
    air = medium(4)
    cut = NetworkConditions(partition=(frozenset({1, 2}),))
    air.apply(cut)
    assert {number for number, _ in draw(air, 0).to_all()} == {1}
    assert {number for number, _ in draw(air, 3).to_all()} == {2}
    assert (air.hears(0, 1), air.hears(0, 2)) == (True, False)
    assert draw(air, 0).copies_to(2) == ()
    air.apply(cut.healed())
    assert {number for number, _ in draw(air, 0).to_all()} == {1, 2, 3}


def test_draws_are_equal_one_by_one_and_all_at_once() -> None:
    for link in ({"loss": 0.3}, {"loss": GilbertElliott(0.1, 0.5), "duplicate": 0.5}):
        one, other = medium(5, **link), medium(5, **link)
        for _ in range(200):
            draws, all_ = draw(one, 2), draw(other, 2).to_all()
            assert [(number, delay) for number in range(5) for delay in draws.copies_to(number)] == all_
            assert all(delay <= draws.latest for _, delay in all_)


def test_each_sender_and_effect_has_its_own_random_stream() -> None:
    """The delay of a message does not depend on messages of other senders, or on a higher loss rate."""
    quiet, busy, lossy = medium(), medium(), medium(loss=0.9)
    for _ in range(500):
        draw(busy, 1)
        expected = dict(draw(quiet, 0).to_all())
        assert dict(draw(busy, 0).to_all()) == expected
        assert dict(draw(lossy, 0).to_all()).items() <= expected.items()


def test_other_seed_gives_other_draws() -> None:
    one, same, other = (draw(medium(seed=seed), 0).to_all() for seed in (1, 1, 2))
    assert one == same != other


def test_unknown_vehicle_is_refused() -> None:
    with pytest.raises(ConditionsError, match="unknown vehicle 9"):
        medium(conditions=NetworkConditions(receivers={9: LinkConditions(loss=1.0)}))
