"""Test the radio model: losses by distance, and their effect on conditions and groups."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.conditions import NetworkConditions
from netem.errors import ConditionsError
from netem.link import Delay, GilbertElliott, LinkConditions
from netem.radio import HardRange, LogDistance, Place, Radio, components, links, over_the_air

GROUND = Place(0.0, 0.0, 0.0)


def far(*north_m: float) -> dict[int, Place]:
    return {vehicle: Place(metres, 0.0, 0.0) for vehicle, metres in enumerate(north_m, 1)}


def test_distance_counts_all_three_directions() -> None:
    assert Place(1.0, 2.0, 3.0).distance_m(Place(3.0, 5.0, 9.0)) == 7.0


def test_hard_range_loses_all_or_nothing() -> None:
    assert [HardRange(100.0).loss(metres) for metres in (0.0, 100.0, 100.1)] == [0.0, 0.0, 1.0]


def test_log_distance_has_the_documented_losses() -> None:
    radio = LogDistance()
    assert [round(radio.loss(metres), 2) for metres in (231.0, 462.0, 924.0)] == [0.01, 0.5, 0.99]
    # Computed by hand: 20 dBm - 40.18 dB over the first metre - 2.32 * 20 dB over the next hundredfold + 82 dBm.
    assert radio.margin_db(100.0) == pytest.approx(20 - 40.18 - 46.4 + 82, abs=0.01)
    assert radio.margin_db(100.0) - radio.margin_db(1000.0) == pytest.approx(23.2)
    # One standard deviation of shadowing from the half: 15.87 % of the normal distribution.
    half_m = 10 ** (radio.margin_db(1.0) / 23.2)
    assert radio.loss(half_m * 10 ** (-3 / 23.2)) == pytest.approx(0.1587, abs=1e-4)
    assert radio.loss(half_m * 10 ** (3 / 23.2)) == pytest.approx(0.8413, abs=1e-4)


def test_log_distance_without_shadowing_is_a_hard_range() -> None:
    radio = LogDistance(shadowing_db=0.0)
    assert [radio.loss(metres) for metres in (461.0, 464.0)] == [0.0, 1.0]


@pytest.mark.parametrize("radio", [HardRange(), LogDistance(), LogDistance(shadowing_db=8.0, exponent=3.5)])
@given(metres=st.lists(st.floats(0, 1e7), min_size=2))
def test_larger_distance_never_loses_less(radio: Radio, metres: list[float]) -> None:
    losses = [radio.loss(one) for one in sorted(metres)]
    assert all(0.0 <= near <= distant <= 1.0 for near, distant in pairwise(losses))


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: HardRange(0.0), r"radio\.range_m: 0\.0 is not above 0"),
        (lambda: HardRange(math.inf), r"radio\.range_m: inf is not a finite number"),
        (lambda: LogDistance(exponent=-2.0), r"radio\.exponent: -2\.0 is not above 0"),
        (lambda: LogDistance(shadowing_db=-1.0), r"radio\.shadowing_db: -1\.0 is below 0; allowed is 0 dB or more"),
        (lambda: LogDistance(power_dbm=math.nan), r"radio\.power_dbm: nan is not a finite number"),
    ],
)
def test_invalid_radio_is_refused(make: object, word: str) -> None:
    with pytest.raises(ConditionsError, match=word):
        make()  # type: ignore[operator]


def test_losses_have_steps_so_that_hovering_changes_nothing() -> None:
    radio = LogDistance()
    assert links(radio, far(0.0, 100.0)) == {}
    found = links(radio, far(0.0, 400.0, 5000.0))
    assert found == {frozenset((1, 2)): 0.31, frozenset((1, 3)): 1.0, frozenset((2, 3)): 1.0}
    assert links(radio, far(0.05, 400.0, 5000.05)) == found


def test_radio_losses_add_to_the_requested_conditions() -> None:
    slow = LinkConditions(0.2, Delay(0.1))
    bursts = LinkConditions(GilbertElliott(0.1, 0.5, 1.0, 0.2))
    asked = NetworkConditions(LinkConditions(0.5), {3: bursts}, {(1, 2): slow}, (frozenset({4}),))
    heard = over_the_air(asked, {frozenset((1, 2)): 0.5, frozenset((2, 3)): 0.1})
    assert heard.link(1, 2) == LinkConditions(0.6, Delay(0.1))
    assert heard.link(2, 1) == LinkConditions(0.75)
    assert heard.link(2, 3).loss == GilbertElliott(0.1, 0.5, 1.0, 1 - 0.8 * 0.9)
    assert heard.link(1, 3) == bursts and heard.link(3, 1) == LinkConditions(0.5)
    assert heard.partition == asked.partition
    assert over_the_air(asked, {}) is asked


def test_components_include_vehicles_reached_through_others() -> None:
    chain = over_the_air(NetworkConditions(), links(HardRange(100.0), far(0.0, 90.0, 180.0, 400.0, 480.0)))
    assert components(chain, (1, 2, 3, 4, 5)) == ({1, 2, 3}, {4, 5})
    assert components(chain.with_partition([[1, 3]]), (1, 2, 3, 4, 5)) == ({4, 5}, {1}, {2}, {3})
    for deaf in ((1, 2), (2, 1)):
        one_way = NetworkConditions(links={deaf: LinkConditions(1.0)})
        assert components(one_way, (1, 2)) == ({1}, {2}), "a link in one direction connects no group"
    bursts = NetworkConditions(LinkConditions(GilbertElliott(0.1, 0.5, 1.0, 1.0)))
    assert components(bursts, (1, 2)) == ({1}, {2})
