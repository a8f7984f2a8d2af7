"""Conditions are values: what they mean, and what is refused and how."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem import addresses
from netem.conditions import LinkConditions, NetworkConditions
from netem.errors import ConditionsError, NetemError


@pytest.mark.parametrize("loss", [-0.1, 1.5, math.nan, math.inf, "0.1", None, True])
def test_a_loss_that_is_no_probability_is_refused_with_the_value_and_what_is_allowed(loss: object) -> None:
    with pytest.raises(ConditionsError, match=r"^loss: .*allowed is .*0\.\.1") as caught:
        LinkConditions(loss=loss)  # type: ignore[arg-type]
    assert repr(loss) in str(caught.value)
    assert isinstance(caught.value, NetemError)
    assert isinstance(caught.value, ValueError)


def test_a_loss_in_percent_is_told_how_to_write_it() -> None:
    with pytest.raises(ConditionsError, match=r"for 15 % write 0\.15"):
        LinkConditions(loss=15)


def test_loss_belongs_to_the_receiver() -> None:
    conditions = NetworkConditions(LinkConditions(0.1), {3: LinkConditions(0.5)})
    assert conditions.link(sender=3, receiver=1).loss == 0.1
    assert conditions.link(sender=1, receiver=3).loss == 0.5


def test_vehicles_in_no_group_form_one_more_group_together() -> None:
    conditions = NetworkConditions().with_partition([[1, 2], [3]])
    assert not conditions.is_cut(1, 2)
    assert conditions.is_cut(1, 3)
    assert conditions.is_cut(1, 4)
    assert conditions.is_cut(5, 3)
    assert not conditions.is_cut(4, 5)
    assert conditions.groups([1, 2, 3, 4, 5]) == ({1, 2}, {3}, {4, 5})


def test_healing_removes_the_partition_and_nothing_else() -> None:
    lossy = NetworkConditions(LinkConditions(0.2), {1: LinkConditions(0.4)})
    assert lossy.with_partition([[1]]).healed() == lossy


def test_fully_connected_means_no_loss_and_no_partition() -> None:
    assert NetworkConditions().fully_connected
    assert not NetworkConditions(LinkConditions(0.01)).fully_connected
    assert not NetworkConditions(receivers={1: LinkConditions(0.01)}).fully_connected
    assert not NetworkConditions().with_partition([[1]]).fully_connected


def test_a_vehicle_in_two_groups_is_refused() -> None:
    with pytest.raises(ConditionsError, match=r"partition\[1\]: vehicle 2 .* one group per vehicle"):
        NetworkConditions().with_partition([[1, 2], [2, 3]])


@pytest.mark.parametrize("group", [[], [0], [65536], ["1"], [True]])
def test_a_group_must_be_vehicle_ids(group: list[object]) -> None:
    with pytest.raises(ConditionsError, match=r"partition\[0\]: .*allowed is"):
        NetworkConditions().with_partition([group])  # type: ignore[list-item]


def test_unknown_vehicles_are_refused_with_the_key_and_who_exists() -> None:
    with pytest.raises(ConditionsError, match=r"partition\[0\]: unknown vehicle 9; .* 1, 2"):
        NetworkConditions().with_partition([[1, 9]]).validate([1, 2])
    with pytest.raises(ConditionsError, match="receivers: unknown vehicles 7, 8"):
        NetworkConditions(receivers={7: LinkConditions(), 8: LinkConditions()}).validate([1, 2])


def test_what_a_caller_changes_later_does_not_change_the_value() -> None:
    receivers = {1: LinkConditions(0.5)}
    conditions = NetworkConditions(receivers=receivers)
    receivers[1] = LinkConditions(0.9)
    assert conditions.link(2, 1).loss == 0.5


def test_an_unknown_key_is_refused() -> None:
    with pytest.raises(ConditionsError, match="los: not a key"):
        NetworkConditions.from_json({"default": {"los": 0.1}})


_links = st.builds(LinkConditions, st.floats(0, 1))


@given(
    _links,
    st.dictionaries(st.integers(1, 65535), _links, max_size=4),
    st.lists(st.integers(1, 9), unique=True).map(lambda ids: tuple(frozenset([i]) for i in ids)),
)
def test_json_brings_the_same_conditions_back(
    default: LinkConditions, receivers: dict[int, LinkConditions], partition: tuple[frozenset[int], ...]
) -> None:
    conditions = NetworkConditions(default, receivers, partition)
    assert NetworkConditions.from_json(conditions.to_json()) == conditions


def test_no_two_ids_share_an_address_and_none_has_the_broadcast_address() -> None:
    ids = range(addresses.MIN_ID, addresses.MAX_ID + 1)
    assert len({addresses.address(i) for i in ids} | {addresses.BROADCAST, "10.76.0.0"}) == len(ids) + 2
    assert len({addresses.mac(i) for i in ids}) == len(ids)
