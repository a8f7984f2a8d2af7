"""Test objects for network conditions: their meaning, and the refusal of invalid conditions."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem import addresses
from netem.conditions import Delay, Distribution, GilbertElliott, LinkConditions, NetworkConditions
from netem.engine import AppliedConditions, Engine, ReceiverFigures
from netem.errors import ConditionsError, EngineError, NetemError


@pytest.mark.parametrize("loss", [-0.1, 1.5, math.nan, math.inf, "0.1", None, True])
def test_invalid_probability_is_refused_with_the_allowed_values(loss: object) -> None:
    with pytest.raises(ConditionsError, match=r"^loss: .*allowed is .*0\.\.1") as caught:
        LinkConditions(loss=loss)  # type: ignore[arg-type]
    assert repr(loss) in str(caught.value)
    assert isinstance(caught.value, NetemError)
    assert isinstance(caught.value, ValueError)


def test_loss_in_percent_is_refused_with_the_right_spelling() -> None:
    with pytest.raises(ConditionsError, match=r"for 15 % write 0\.15"):
        LinkConditions(loss=15)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: GilbertElliott(1.5, 0.1), r"^loss\.p: 1\.5 is not a probability; allowed is 0\.\.1"),
        (lambda: GilbertElliott(0.1, True), r"^loss\.r: True is not a number; allowed is a probability 0\.\.1"),
        (lambda: GilbertElliott(0.1, 0.1, loss_bad=math.nan), r"^loss\.loss_bad: nan is not"),
        (lambda: GilbertElliott(0.1, 0.1, loss_good=-1), r"^loss\.loss_good: -1 is not"),
        (lambda: Delay(-0.1), r"^delay\.mean_s: -0\.1 is out of range; allowed is seconds 0\.\.60"),
        (lambda: Delay(61), r"^delay\.mean_s: 61\.0 is out of range; allowed is seconds 0\.\.60"),
        (lambda: Delay(math.nan), r"^delay\.mean_s: nan is not a number"),
        (lambda: Delay("1"), r"^delay\.mean_s: '1' is not a number"),  # type: ignore[arg-type]
        (lambda: Delay(0.1, 0.2), r"^delay\.jitter_s: 0\.2 is out of range; allowed is 0\.\.mean_s, 0\.1"),
        (lambda: Delay(0, 0.1), r"^delay\.jitter_s: 0\.1 is out of range"),
        (lambda: Delay(0.1, -0.1), r"^delay\.jitter_s: -0\.1 is out of range"),
        (lambda: Delay(0.1, 0, "gauss"), r"^delay\.distribution: 'gauss' is not known; allowed is uniform, normal, "),
        (lambda: LinkConditions(delay=0.1), r"^delay: 0\.1 is not a delay"),
        (lambda: LinkConditions(duplicate=2), r"^duplicate: 2 is not a probability"),
        (lambda: LinkConditions(reorder=2, delay=Delay(1)), r"^reorder: 2 is not a probability"),
        (lambda: LinkConditions(reorder=0.1), r"^reorder: 0\.1 needs a delay"),
        (lambda: LinkConditions(delay=Delay(0), reorder=0.1), r"^reorder: 0\.1 needs a delay"),
        (lambda: LinkConditions(corrupt=-0.1), r"^corrupt: -0\.1 is not a probability"),
        (lambda: LinkConditions(rate=0), r"^rate: 0 is out of range; allowed is bits per second, 8 or more, or None"),
        (lambda: LinkConditions(rate=-1e6), r"^rate: -1000000\.0 is out of range"),
        (lambda: LinkConditions(rate=math.inf), r"^rate: inf is out of range"),
        (lambda: LinkConditions(rate=math.nan), r"^rate: nan is not a number"),
        (lambda: LinkConditions(rate="1mbit"), r"^rate: '1mbit' is not a number; allowed is bits per second"),
        (lambda: LinkConditions(rate=True), r"^rate: True is not a number"),
        (lambda: LinkConditions(rate=1e6, limit=0), r"^limit: 0 is out of range; allowed is a whole number of packets"),
        (lambda: LinkConditions(rate=1e6, limit=2.5), r"^limit: 2\.5 is out of range"),
        (lambda: LinkConditions(rate=1e6, limit=True), r"^limit: True is out of range"),
        (lambda: LinkConditions(rate=1e6, limit=100_001), r"^limit: 100001 is out of range; allowed is .*1\.\.100000"),
        (lambda: LinkConditions(limit=10), r"^limit: 10 needs a delay or a rate to wait for; allowed is None"),
        (lambda: LinkConditions(delay=Delay(0), limit=10), r"^limit: 10 needs a delay or a rate"),
        (lambda: NetworkConditions(LinkConditions(rate=8)).at_speed(0.5), r"^rate: 4\.0 is out of range"),
        (lambda: NetworkConditions(LinkConditions(delay=Delay(60))).at_speed(0.5), r"^delay\.mean_s: 120\.0 is out of"),
        (lambda: NetworkConditions(links={(1, 1): LinkConditions()}), "^links: 1>1 leads to itself"),
        (lambda: NetworkConditions(links={(1, 0): LinkConditions()}), "^links: 0 is not a vehicle ID"),
        (lambda: NetworkConditions.from_json({"links": {"1-2": {}}}), "^links: '1-2' is not a link; .* \"1>2\""),
        (lambda: LinkConditions.from_json({"loss": {"p": 0.1}}), r"^loss\.r: is missing"),
        (lambda: LinkConditions.from_json({"loss": {"p": 0.1, "r": 0.1, "k": 1}}), r"^loss\.k: not a key"),
        (lambda: LinkConditions.from_json({"delay": {"jitter_s": 1}}), r"^delay\.mean_s: is missing"),
    ],
)
def test_invalid_value_is_refused_with_key_value_and_allowed_values(make: Any, sentence: str) -> None:
    with pytest.raises(ConditionsError, match=sentence) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_delay_of_zero_is_none() -> None:
    assert LinkConditions(delay=Delay(0)) == LinkConditions()


def test_mean_of_bursts_is_the_loss_in_the_long_run() -> None:
    assert GilbertElliott(0.1, 0.3).mean == pytest.approx(0.25)
    assert GilbertElliott(0.1, 0.3, 0.8, 0.04).mean == pytest.approx(0.23)
    assert GilbertElliott(0, 0, loss_good=0.2).mean == 0.2  # begins in the good state and stays in it
    assert GilbertElliott(0.1, 0).mean == 1


def test_lossless_link_never_loses_a_packet() -> None:
    late = LinkConditions(delay=Delay(0.1), duplicate=0.5, reorder=0.5)
    assert late.lossless
    assert NetworkConditions(late).fully_connected
    assert LinkConditions(GilbertElliott(0, 0.5)).lossless
    assert LinkConditions(GilbertElliott(0.5, 0.5, loss_bad=0)).lossless
    assert not LinkConditions(GilbertElliott(0.5, 0.5)).lossless
    # A mean of 0, but a different value at first.
    assert not LinkConditions(GilbertElliott(0.5, 0, 0, loss_good=0.1)).lossless
    assert not LinkConditions(0.1).lossless
    assert LinkConditions(rate=1e6).lossless
    assert not LinkConditions(rate=1e6, limit=1000).lossless
    assert not LinkConditions(corrupt=0.1).lossless


def test_link_with_memory_depends_on_earlier_packets() -> None:
    bursts = LinkConditions(GilbertElliott(0.1, 0.1))
    assert all(it.remembers for it in (bursts, LinkConditions(rate=1e6), LinkConditions(delay=Delay(1), limit=5)))
    assert not LinkConditions(0.1, Delay(0.1, 0.1), 0.1, 0.1, 0.1).remembers


def test_at_speed_changes_only_delays_and_rates() -> None:
    link = LinkConditions(0.1, Delay(2, 1, "pareto"), 0.1, 0.2, 0.3, 1e6, 50)
    fast = LinkConditions(0.1, Delay(0.1, 0.05, "pareto"), 0.1, 0.2, 0.3, 2e7, 50)
    slow = NetworkConditions(link, {1: link}, {(1, 2): link}, ({3},))
    assert slow.at_speed(20) == NetworkConditions(fast, {1: fast}, {(1, 2): fast}, ({3},))
    assert slow.at_speed(1) is slow
    assert NetworkConditions(LinkConditions(0.1)).at_speed(20) == NetworkConditions(LinkConditions(0.1))


def test_link_overrides_receiver_and_receiver_overrides_default() -> None:
    conditions = NetworkConditions(
        LinkConditions(0.1), {2: LinkConditions(0.2)}, {(1, 2): LinkConditions(), (1, 3): LinkConditions(0.4)}
    )
    assert conditions.link(1, 2).loss == 0
    assert conditions.link(3, 2).loss == 0.2
    assert conditions.link(1, 3).loss == 0.4
    assert conditions.link(3, 1).loss == 0.1
    assert conditions.link(2, 2).loss == 0.2


def test_needs_name_each_further_condition_once_with_its_place() -> None:
    assert NetworkConditions(LinkConditions(0.1), {1: LinkConditions(0.2)}, partition=({1},)).needs() == ()
    late = LinkConditions(delay=Delay(0.1), reorder=0.1)
    both = LinkConditions(GilbertElliott(0.1, 0.1), Delay(0.1), 0.1)
    assert NetworkConditions(late).needs() == ("delay", "reorder")
    assert NetworkConditions(late, {3: both, 4: both}).needs() == (
        "delay",
        "reorder",
        "receivers 3 loss in bursts",
        "receivers 3 duplicate",
    )
    links = {(1, 2): LinkConditions(0.2), (1, 3): both, (2, 3): both}
    assert NetworkConditions(late, links=links).needs() == (
        "delay",
        "reorder",
        "links 1>3 loss in bursts",
        "links 1>3 duplicate",
    )
    slow = LinkConditions(corrupt=0.1, rate=1e6, limit=5)
    assert NetworkConditions(slow).needs() == ("corrupt", "rate", "limit")


def test_differing_links_are_those_unlike_their_receiver() -> None:
    lossy = {pair: LinkConditions(0.2) for pair in ((1, 2), (1, 3), (2, 3))}
    assert [*NetworkConditions(receivers={2: LinkConditions(0.2)}, links=lossy).differing_links()] == [
        (1, 3, LinkConditions(0.2)),
        (2, 3, LinkConditions(0.2)),
    ]
    assert [*NetworkConditions(LinkConditions(0.2), links=lossy).differing_links()] == []


class _Untouchable(Engine):
    name = "untouchable"
    has_queues = False

    def change(self, conditions: NetworkConditions) -> None:
        raise AssertionError("changed")

    def read(self) -> AppliedConditions:
        raise AssertionError("read")


@pytest.mark.parametrize(
    ("conditions", "need"),
    [
        (NetworkConditions(LinkConditions(GilbertElliott(0.1, 0.1))), "not loss in bursts;"),
        (NetworkConditions(LinkConditions(delay=Delay(0.1), reorder=0.1)), "not delay, reorder;"),
        (NetworkConditions(receivers={2: LinkConditions(duplicate=0.1)}), "not receivers 2 duplicate;"),
        (NetworkConditions(links={(1, 2): LinkConditions(rate=1e6)}), "not links 1>2 rate;"),
    ],
)
def test_engine_refuses_unsupported_conditions_before_any_change(conditions: NetworkConditions, need: str) -> None:
    engine = _Untouchable(SimpleNamespace(vehicles=(1, 2)))  # type: ignore[arg-type]
    with pytest.raises(EngineError, match=f"^Engine untouchable .* {need} .*--backend sim"):
        engine.apply(conditions)


class _ForgetfulEngine(Engine):
    """An engine that fails to apply the conditions in `refused`. If `stuck` is true, it keeps the first conditions
    forever.
    """

    name = "forgetful"
    has_queues = True
    refused = LinkConditions(0.9)
    stuck = False

    def change(self, conditions: NetworkConditions) -> None:
        if conditions.default == self.refused:
            self._held = NetworkConditions(LinkConditions(0.5))
            raise EngineError("The kernel said no")
        if not (self.stuck and hasattr(self, "_held")):
            self._held = conditions

    def read(self) -> AppliedConditions:
        held = {sender: self._held.link(sender, 1) for sender in (2, 3)}
        return AppliedConditions(self.name, {1: ReceiverFigures.of(held, (), 0, 0, 0)})


def test_refused_change_is_undone_and_reported() -> None:
    engine = _ForgetfulEngine(SimpleNamespace(vehicles=(1, 2, 3)))  # type: ignore[arg-type]
    engine.apply(NetworkConditions(LinkConditions(0.1)))
    with pytest.raises(
        EngineError,
        match=r"^The kernel said no\. Requested: .*0\.9.*; the previous conditions are in effect again: .*0\.1",
    ):
        engine.apply(NetworkConditions(LinkConditions(0.9)))
    assert engine.read().receivers[1].loss == 0.1


def test_failed_undo_is_reported_with_the_conditions_in_force() -> None:
    engine = _ForgetfulEngine(SimpleNamespace(vehicles=(1, 2, 3)))  # type: ignore[arg-type]
    engine.apply(NetworkConditions(LinkConditions(0.1)))
    engine.stuck = True
    word = (
        r"said no\. Requested: .*0\.9.* could not be restored "
        r"\(.*requested .*0\.1.*in effect .*0\.5.*\); in effect: .*0\.5"
    )
    with pytest.raises(EngineError, match=word):
        engine.apply(NetworkConditions(LinkConditions(0.9)))


@pytest.mark.parametrize(
    ("asked", "held", "differing"),
    [
        (LinkConditions(0.1), LinkConditions(0.1 + 1e-9), None),
        (LinkConditions(0.1), LinkConditions(0.1 + 2e-9), "loss"),
        (LinkConditions(0.1), LinkConditions(GilbertElliott(0.1, 0.1)), "loss"),
        (LinkConditions(delay=Delay(0.1)), LinkConditions(delay=Delay(0.1, 0, "normal")), None),
        (LinkConditions(delay=Delay(0.1, 0.1)), LinkConditions(delay=Delay(0.1, 0.1, "normal")), "delay.distribution"),
        (LinkConditions(delay=Delay(0.1)), LinkConditions(), "delay.mean_s"),
        (LinkConditions(rate=1e6 + 3), LinkConditions(rate=1e6), None),
        (LinkConditions(rate=1e6 + 9), LinkConditions(rate=1e6), "rate"),
        (LinkConditions(rate=1e6), LinkConditions(rate=1e6, limit=100), "limit"),
    ],
)
def test_state_of_the_kernel_is_compared_within_the_resolution(
    asked: LinkConditions, held: LinkConditions, differing: str | None
) -> None:
    engine = _ForgetfulEngine(SimpleNamespace(vehicles=(1, 2, 3)))  # type: ignore[arg-type]
    engine.stuck = True
    engine._held = NetworkConditions(held)
    if differing is None:
        engine.apply(NetworkConditions(asked))
    else:
        with pytest.raises(EngineError, match=f"does not apply the requested {differing}"):
            engine.apply(NetworkConditions(asked))


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


def test_vehicle_in_two_groups_is_refused() -> None:
    with pytest.raises(ConditionsError, match=r"partition\[1\]: vehicle 2 .* one group per vehicle"):
        NetworkConditions().with_partition([[1, 2], [2, 3]])


@pytest.mark.parametrize("group", [[], [0], [65536], ["1"], [True]])
def test_group_must_be_vehicle_ids(group: list[object]) -> None:
    with pytest.raises(ConditionsError, match=r"partition\[0\]: .*allowed is"):
        NetworkConditions().with_partition([group])  # type: ignore[list-item]


def test_unknown_vehicles_are_refused_with_key_and_known_vehicles() -> None:
    with pytest.raises(ConditionsError, match=r"partition\[0\]: unknown vehicle 9; .* 1, 2"):
        NetworkConditions().with_partition([[1, 9]]).validate([1, 2])
    with pytest.raises(ConditionsError, match="receivers: unknown vehicles 7, 8"):
        NetworkConditions(receivers={7: LinkConditions(), 8: LinkConditions()}).validate([1, 2])
    with pytest.raises(ConditionsError, match="links: unknown vehicles 7, 8"):
        NetworkConditions(links={(1, 7): LinkConditions(), (8, 1): LinkConditions()}).validate([1, 2])


def test_later_changes_by_the_caller_do_not_change_the_value() -> None:
    receivers = {1: LinkConditions(0.5)}
    conditions = NetworkConditions(receivers=receivers)
    receivers[1] = LinkConditions(0.9)
    assert conditions.link(2, 1).loss == 0.5


def test_unknown_key_is_refused() -> None:
    with pytest.raises(ConditionsError, match="los: not a key"):
        NetworkConditions.from_json({"default": {"los": 0.1}})


def test_json_of_a_plain_loss_has_one_key() -> None:
    assert LinkConditions(0.1).to_json() == {"loss": 0.1}
    old = {"default": {"loss": 0.1}, "receivers": {"2": {"loss": 0.5}}, "partition": [[1]]}
    assert NetworkConditions.from_json(old) == NetworkConditions(
        LinkConditions(0.1), {2: LinkConditions(0.5)}, partition=({1},)
    )


_shares = st.floats(0, 1)
_bursts = st.builds(GilbertElliott, _shares, _shares, _shares, _shares)
_delays = st.floats(0.001, 60).flatmap(
    lambda mean_s: st.builds(Delay, st.just(mean_s), st.floats(0, mean_s), st.sampled_from(get_args(Distribution)))
)
_rates = st.none() | st.floats(8, 1e12)
_limits = st.none() | st.integers(1, 100_000)
_links = st.builds(LinkConditions, _shares | _bursts, st.none(), _shares, corrupt=_shares, rate=_rates) | st.builds(
    LinkConditions, _shares | _bursts, _delays, _shares, _shares, _shares, _rates, _limits
)
_vehicles = st.integers(1, 65535)
_pairs = st.tuples(_vehicles, _vehicles).filter(lambda pair: pair[0] != pair[1])


@given(
    _links,
    st.dictionaries(_vehicles, _links, max_size=4),
    st.dictionaries(_pairs, _links, max_size=4),
    st.lists(st.integers(1, 9), unique=True).map(lambda ids: tuple(frozenset([i]) for i in ids)),
)
def test_json_round_trip_keeps_the_conditions(
    default: LinkConditions,
    receivers: dict[int, LinkConditions],
    links: dict[tuple[int, int], LinkConditions],
    partition: tuple[frozenset[int], ...],
) -> None:
    conditions = NetworkConditions(default, receivers, links, partition)
    assert NetworkConditions.from_json(json.loads(json.dumps(conditions.to_json()))) == conditions


@given(_bursts)
def test_mean_of_bursts_lies_between_the_two_losses(bursts: GilbertElliott) -> None:
    low, high = sorted((bursts.loss_good, bursts.loss_bad))
    assert low - 1e-9 <= bursts.mean <= high + 1e-9


def test_no_two_ids_share_an_address_and_none_has_the_broadcast_address() -> None:
    ids = range(addresses.MIN_ID, addresses.MAX_ID + 1)
    assert len({addresses.address(i) for i in ids} | {addresses.BROADCAST, "10.76.0.0"}) == len(ids) + 2
    assert len({addresses.mac(i) for i in ids}) == len(ids)
