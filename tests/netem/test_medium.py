"""The air in virtual time does what conditions ask: counted over many broadcasts of a fixed seed."""

from collections import Counter
from statistics import fmean, stdev
from typing import Any

import pytest

from netem.conditions import Delay, GilbertElliott, LinkConditions, NetworkConditions
from netem.errors import ConditionsError
from netem.medium import Medium, sample

BROADCASTS = 20_000


def medium(vehicles: int = 3, seed: int = 1, *, conditions: NetworkConditions | None = None, **link: Any) -> Medium:
    air = Medium(range(1, vehicles + 1), seed)
    air.apply(conditions or NetworkConditions(LinkConditions(**link)))
    return air


def delays(air: Medium, sender: int, receiver: int, broadcasts: int = BROADCASTS) -> list[list[float]]:
    """The delays of the copies of each broadcast of one sender at one receiver, by their numbers."""
    return [[delay for number, delay in air.draw(sender).to_all() if number == receiver] for _ in range(broadcasts)]


def lost(copies: list[list[float]]) -> float:
    return sum(not one for one in copies) / len(copies)


@pytest.mark.parametrize("loss", [0.0, 0.15, 0.5, 1.0])
def test_every_receiver_loses_independently_what_was_asked(loss: float) -> None:
    air = medium(loss=loss)
    heard = Counter(number for _ in range(BROADCASTS) for number, _ in air.draw(0).to_all())
    assert [1 - heard[number] / BROADCASTS for number in (1, 2)] == [pytest.approx(loss, abs=0.012)] * 2
    both = sum(len(air.draw(0).to_all()) == 2 for _ in range(BROADCASTS)) / BROADCASTS
    assert both == pytest.approx((1 - loss) ** 2, abs=0.012)
    assert heard[0] == 0  # nobody hears itself


def test_loss_in_bursts_has_the_mean_and_the_length_of_its_model() -> None:
    bursts = GilbertElliott(p=0.05, r=0.25)
    copies = delays(medium(loss=bursts), 0, 1, 40_000)
    assert lost(copies) == pytest.approx(bursts.mean, abs=0.01)
    runs = "".join("x" if not one else "." for one in copies).replace(".", " ").split()
    assert fmean(map(len, runs)) == pytest.approx(1 / 0.25, rel=0.05)


def test_without_a_delay_messages_take_2_to_50_ms_uniformly() -> None:
    taken = [delay for copies in delays(medium(), 0, 1) for delay in copies]
    assert 0.002 <= min(taken) < 0.003
    assert 0.049 < max(taken) <= 0.05
    assert fmean(taken) == pytest.approx(0.026, abs=0.0005)
    assert stdev(taken) == pytest.approx(0.048 / 12**0.5, rel=0.02)


@pytest.mark.parametrize("distribution", ["uniform", "normal", "pareto", "paretonormal"])
def test_a_delay_has_its_mean_and_jitter(distribution: str) -> None:
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
    assert sample(Delay(0.1, 0.1, "normal"), 0.0001) == 0.0


def test_duplicates_come_twice_and_overtakers_at_once() -> None:
    copies = delays(medium(delay=Delay(1.0), duplicate=0.1, reorder=0.25, loss=0.2), 0, 1)
    heard = [one for one in copies if one]
    assert lost(copies) == pytest.approx(0.2, abs=0.012)
    assert sum(len(one) == 2 for one in heard) / len(heard) == pytest.approx(0.1, abs=0.01)
    assert sum(one[0] == 0.0 for one in heard) / len(heard) == pytest.approx(0.25, abs=0.012)


def test_a_bit_error_is_a_loss_of_its_own() -> None:
    assert lost(delays(medium(corrupt=0.2), 0, 1)) == pytest.approx(0.2, abs=0.012)
    assert lost(delays(medium(corrupt=0.2, loss=0.5), 0, 1)) == pytest.approx(0.6, abs=0.012)


def test_receivers_and_links_differ_in_one_direction_only() -> None:
    air = medium(
        conditions=NetworkConditions(
            receivers={2: LinkConditions(loss=0.5)}, links={(3, 1): LinkConditions(loss=1.0, delay=Delay(1.0))}
        )
    )
    assert lost(delays(air, 0, 1)) == pytest.approx(0.5, abs=0.012)
    assert lost(delays(air, 0, 2)) == 0.0
    assert lost(delays(air, 2, 0, 100)) == 1.0
    assert lost(delays(air, 1, 0, 100)) == 0.0


def test_nothing_crosses_a_partition_and_all_does_after_heal() -> None:
    air = medium(4)
    cut = NetworkConditions(partition=(frozenset({1, 2}),))
    air.apply(cut)
    assert {number for number, _ in air.draw(0).to_all()} == {1}
    assert {number for number, _ in air.draw(3).to_all()} == {2}
    assert (air.hears(0, 1), air.hears(0, 2)) == (True, False)
    assert air.draw(0).copies_to(2) == ()
    air.apply(cut.healed())
    assert {number for number, _ in air.draw(0).to_all()} == {1, 2, 3}


def test_lots_read_one_by_one_are_those_read_all_at_once() -> None:
    for link in ({"loss": 0.3}, {"loss": GilbertElliott(0.1, 0.5), "duplicate": 0.5}):
        one, other = medium(5, **link), medium(5, **link)
        for _ in range(200):
            lots, all_ = one.draw(2), other.draw(2).to_all()
            assert [(number, delay) for number in range(5) for delay in lots.copies_to(number)] == all_
            assert all(delay <= lots.latest for _, delay in all_)


def test_streams_are_one_per_sender_and_concern() -> None:
    """Neither another sender's words nor more loss change how long a message takes."""
    quiet, busy, lossy = medium(), medium(), medium(loss=0.9)
    for _ in range(500):
        busy.draw(1)
        expected = dict(quiet.draw(0).to_all())
        assert dict(busy.draw(0).to_all()) == expected
        assert dict(lossy.draw(0).to_all()).items() <= expected.items()


def test_a_seed_is_another_air() -> None:
    assert medium(seed=1).draw(0).to_all() == medium(seed=1).draw(0).to_all() != medium(seed=2).draw(0).to_all()


def test_an_unknown_vehicle_is_refused() -> None:
    with pytest.raises(ConditionsError, match="unknown vehicle 9"):
        medium(conditions=NetworkConditions(receivers={9: LinkConditions(loss=1.0)}))
