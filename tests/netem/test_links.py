"""Test all effects of netem on a link: delays and their distributions, bursts of losses, duplicates, and others.

The kernel decides at random, so the tests compare figures with wide intervals. With a correct program, about one of
100,000 checks fails.
"""

from __future__ import annotations

import asyncio
import math
import statistics
from collections import Counter
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any, get_args

import pytest

from harness.errors import MachineError
from harness.play.process.process_preflight import refuse_unsupported_network
from harness.scenario import Scenario
from netem.conditions import NetworkConditions
from netem.errors import EngineError
from netem.lab import Lab, LabUnavailable
from netem.link import MAX_LIMIT, Delay, Distribution, GilbertElliott, LinkConditions
from tests.netem.conftest import PACKETS, PORT, Air, assert_binomial, play
from tests.netem.test_engine import in_lab

pytestmark = pytest.mark.lab

HEADERS = 42  # bytes: Ethernet, IPv4, UDP
LATE_S = 0.015  # lateness of the test machine that the reference may not show


async def heard(air: Air, sender: int, receivers: dict[int, Any], count: int, size: int = 12) -> dict[int, Any]:
    """Broadcast packets, and return the report of each receiver."""
    listeners = {vehicle: await air.start_ready(vehicle, "receive", PORT) for vehicle in receivers}
    await air.broadcast(sender, count, size=size)
    await until_quiet(air)
    found = {vehicle: await listener.finish() for vehicle, listener in listeners.items()}
    assert all(result["overflow"] == 0 for result in found.values()), "a receiver was too slow to judge by"
    return found


async def until_quiet(air: Air) -> None:
    """Wait until no packet is in transit."""
    before = None
    while before != (now := (await air.lab.read()).receivers):
        before = now
        await asyncio.sleep(0.5)


def to_each(links: dict[int, LinkConditions]) -> NetworkConditions:
    return NetworkConditions(receivers=links)


def test_delays_have_the_requested_mean_deviation_and_shape(netem: str, tmp_path: Path) -> None:
    shapes: dict[int, Delay] = {2: Delay(0.05)}
    shapes |= {3 + i: Delay(0.1, 0.02, shape) for i, shape in enumerate(get_args(Distribution))}

    async def story(air: Air) -> None:
        applied = await air.lab.apply(to_each({vehicle: LinkConditions(delay=it) for vehicle, it in shapes.items()}))
        assert {vehicle: applied.receivers[vehicle].link.delay for vehicle in shapes} == shapes
        found = await heard(air, 1, shapes, PACKETS)
        late_s = statistics.median(found[2]["delays_s"]) - shapes[2].mean_s  # because this machine also does other work
        for vehicle, delay in shapes.items():
            delays_s = found[vehicle]["delays_s"]
            assert sorted(found[vehicle]["numbers"]) == list(range(PACKETS))
            # Five standard errors of the median of a normal distribution, plus the resolution of the clocks.
            early_s = 5 * 1.2533 * delay.jitter_s / math.sqrt(PACKETS) + 0.001
            assert -early_s < statistics.median(delays_s) - median(delay) < late_s + LATE_S, delay
            if delay.distribution in ("uniform", "normal"):
                # The middle half, which an interruption of the test machine does not change.
                quarter, _, three_quarters = statistics.quantiles(delays_s)
                width = delay.jitter_s * (1 if delay.distribution == "uniform" else 1.349)
                assert three_quarters - quarter == pytest.approx(width, rel=0.15, abs=0.005)
                assert min(delays_s) > delay.mean_s - delay.jitter_s * (1 if delay.distribution == "uniform" else 5)
            else:  # few very long delays
                assert skewness(delays_s) > 1

    in_lab(range(1, 7), netem, tmp_path, story)


def median(delay: Delay) -> float:
    """Return the median of a delay in seconds. With the Pareto distribution, the median is less than the mean."""
    shift = {"pareto": -0.32, "paretonormal": -0.2}.get(delay.distribution, 0.0)
    return delay.mean_s + shift * delay.jitter_s


def skewness(values: list[float]) -> float:
    mean, deviation = statistics.fmean(values), statistics.pstdev(values)
    return statistics.fmean(((value - mean) / deviation) ** 3 for value in values)


def test_bursts_are_as_requested_and_independent_between_links(netem: str, tmp_path: Path) -> None:
    bursts = GilbertElliott(0.05, 0.25)
    soft = GilbertElliott(0.2, 0.2, loss_bad=0.9, loss_good=0.1)

    async def story(air: Air) -> None:
        applied = await air.lab.apply(to_each({v: LinkConditions(bursts) for v in (2, 3)} | {4: LinkConditions(soft)}))
        assert applied.receivers[2].link.loss == bursts
        assert applied.receivers[4].link.loss == soft
        found = await heard(air, 1, {2: bursts, 3: bursts, 4: soft}, PACKETS)
        got = {vehicle: set(result["numbers"]) for vehicle, result in found.items()}
        for vehicle in (2, 3):
            # Losses show the state. Therefore count the changes of the state from packet to packet.
            pairs = Counter((number in got[vehicle], number + 1 in got[vehicle]) for number in range(PACKETS - 1))
            assert_binomial(pairs[True, False], pairs[True, False] + pairs[True, True], bursts.p)
            assert_binomial(pairs[False, True], pairs[False, True] + pairs[False, False], bursts.r)
        assert got[2] != got[3]
        assert 1 - len(got[4]) / PACKETS == pytest.approx(soft.mean, abs=0.12)

    in_lab(range(1, 5), netem, tmp_path, story)


def test_shares_of_duplicates_reorders_and_corruptions_are_as_requested(netem: str, tmp_path: Path) -> None:
    size = 1000

    async def story(air: Air) -> None:
        links = {
            2: LinkConditions(duplicate=0.3),
            3: LinkConditions(delay=Delay(0.2), reorder=0.25),
            4: LinkConditions(corrupt=0.2),
        }
        await air.lab.apply(to_each(links))
        found = await heard(air, 1, links, PACKETS, size)
        copies = Counter(found[2]["numbers"])
        assert copies.keys() == set(range(PACKETS))
        assert set(copies.values()) == {1, 2}
        assert_binomial(sum(count == 2 for count in copies.values()), PACKETS, 0.3)
        assert len(found[3]["numbers"]) == PACKETS
        assert_binomial(sum(delay_s < 0.1 for delay_s in found[3]["delays_s"]), PACKETS, 0.25)
        assert found[3]["numbers"] != sorted(found[3]["numbers"])
        # The 12 bytes of addresses in an Ethernet frame have no checksum.
        assert set(found[4]["numbers"]) <= set(range(PACKETS))
        lost = PACKETS - len(found[4]["numbers"])
        assert_binomial(lost, PACKETS, 0.2 * (1 - 12 / (size + HEADERS)))
        assert 0 < found[4]["corrupt"] <= lost

    in_lab(range(1, 5), netem, tmp_path, story)


def test_rate_applies_per_sender_and_limit_loses_excess_packets(netem: str, tmp_path: Path) -> None:
    size, count, rate, limit = 1000, 250, 2e6, 40
    each_s = (size + HEADERS) * 8 / rate

    async def story(air: Air) -> None:
        links = {2: LinkConditions(rate=rate), 3: LinkConditions(rate=rate, limit=limit)}
        applied = await air.lab.apply(to_each(links))
        assert applied.receivers[3].link == links[3]
        listeners = {vehicle: await air.start_ready(vehicle, "receive", PORT) for vehicle in links}
        await asyncio.gather(air.broadcast(1, count, size=size), air.broadcast(4, count, 10_000, size))
        await until_quiet(air)
        found = {vehicle: await listener.finish() for vehicle, listener in listeners.items()}
        for first in (0, 10_000):
            own = range(first, first + count)
            at_s = [at for number, at in zip(found[2]["numbers"], found[2]["at_s"], strict=True) if number in own]
            assert len(at_s) == count
            assert max(at_s) - min(at_s) == pytest.approx((count - 1) * each_s, rel=0.1)
            assert limit <= sum(number in own for number in found[3]["numbers"]) < count
        figures = (await air.lab.read()).receivers[3]
        assert figures.passed + figures.lost == 2 * count
        assert figures.passed == len(found[3]["numbers"])

    in_lab(range(1, 5), netem, tmp_path, story)


def test_change_loses_no_packet_on_its_way(netem: str, tmp_path: Path) -> None:
    slow = LinkConditions(delay=Delay(2.0))

    async def story(air: Air) -> None:
        lab = air.lab
        await lab.apply(NetworkConditions(slow))
        listeners = {vehicle: await air.start_ready(vehicle, "receive", PORT) for vehicle in (2, 3)}
        await air.broadcast(1, 200)
        changes = [
            NetworkConditions(LinkConditions(1.0, Delay(1.0, 0.1, "normal"))),
            NetworkConditions(slow, {2: LinkConditions(GilbertElliott(1, 0))}),
            NetworkConditions(LinkConditions(1.0), links={(1, 2): LinkConditions(0.5, Delay(0.1))}),
            NetworkConditions().with_partition([[1]]),
        ]
        for conditions in changes:
            applied = await lab.apply(conditions)
            assert all(applied.receivers[vehicle].passed == 0 for vehicle in listeners), "the machine is too slow"
        while any(applied.receivers[vehicle].passed < 200 for vehicle in listeners):
            await asyncio.sleep(0.1)
            applied = await lab.read()
        for vehicle, listener in listeners.items():
            assert sorted((await listener.finish())["numbers"]) == list(range(200))
            assert applied.receivers[vehicle].passed == 200

    in_lab(range(1, 4), netem, tmp_path, story)


def test_kernel_applies_any_conditions_of_any_pair(netem: str, tmp_path: Path) -> None:
    random = Random(7)

    def anything() -> LinkConditions:
        share = lambda: random.choice([0.0, 1e-12, random.random(), 1 - 1e-12, 1.0])  # noqa: E731
        mean_s = random.choice([1e-9, random.random(), 60.0])
        shape = random.choice(get_args(Distribution))
        return LinkConditions(
            random.choice([share(), GilbertElliott(share(), share(), share(), share())]),
            Delay(mean_s, min(mean_s, 2.0) * random.random(), shape),
            reorder=share(),
            corrupt=share(),
            rate=random.choice([None, 8.0, 9600.0, 1e6, 1e12]),
            limit=random.choice([None, 1, MAX_LIMIT]),
        )

    async def story(air: Air) -> None:
        pairs = [(one, other) for one in air.lab.vehicles for other in air.lab.vehicles if one != other]
        for _ in range(10):
            links = {pair: anything() for pair in pairs if random.random() < 0.8}
            asked = NetworkConditions(anything(), {2: anything()}, links)
            applied = await air.lab.apply(asked)  # raises EngineError if the kernel holds anything else
            assert type(applied).from_json(applied.to_json()) == applied
            for sender, receiver in pairs:
                delay, held = asked.link(sender, receiver).delay, applied.receivers[receiver].from_sender(sender).delay
                assert delay is not None
                assert held is not None
                assert held.mean_s == pytest.approx(delay.mean_s, abs=1e-9)
                assert held.distribution == delay.distribution or held.jitter_s == 0

    in_lab(range(1, 6), netem, tmp_path, story)


def test_refused_change_leaves_the_previous_conditions_in_force(netem: str, tmp_path: Path) -> None:
    good = NetworkConditions(LinkConditions(0.1), links={(1, 2): LinkConditions(0.2, Delay(0.1))}).with_partition([[3]])
    # The kernel stores a jitter with 31 bits of nanoseconds. It accepts a larger value, but stores a smaller one.
    far = NetworkConditions(LinkConditions(0.5), {2: LinkConditions(delay=Delay(10, 5))})

    async def story(air: Air) -> None:
        before = await air.lab.apply(good)
        with pytest.raises(
            EngineError, match=r"does not apply the requested delay\.jitter_s .* 5\.0.* in effect again: "
        ) as caught:
            await air.lab.apply(far)
        assert "Requested: {'default': {'loss': 0.5}" in str(caught.value)
        assert await air.lab.read() == before

    in_lab([1, 2, 3], netem, tmp_path, story)


def test_kernel_without_mixed_duplicates_refuses_and_changes_nothing(netem: str, tmp_path: Path) -> None:
    twice = LinkConditions(duplicate=0.5)

    async def story(air: Air) -> None:
        before = await air.lab.apply(NetworkConditions(LinkConditions(0.1), {2: LinkConditions(delay=Delay(0.1))}))
        try:
            await air.lab.apply(NetworkConditions(twice, links={(1, 2): LinkConditions(0.5, duplicate=0.5)}))
        except EngineError as error:
            assert "duplicat" in str(error)
            assert "in effect again" in str(error)
            assert await air.lab.read() == before
        # With equal conditions for all senders they work on all kernels, before and after other conditions.
        await air.lab.apply(NetworkConditions(twice))
        await air.lab.apply(NetworkConditions(twice).with_partition([[1]]))
        await air.lab.apply(NetworkConditions(links={(1, 2): LinkConditions(0.5)}))
        applied = await air.lab.apply(NetworkConditions(twice))
        assert applied.receivers[2].link == twice

    in_lab([1, 2, 3], netem, tmp_path, story)


def test_preflight_finds_conditions_that_some_kernels_refuse(netem: str) -> None:
    def scenario(jitter_s: float) -> Scenario:
        ramp = {"at_s": 60, "loss": 0.1}
        delay = {"mean_s": 6, "jitter_s": jitter_s, "distribution": "normal"}
        links = [{"from": 1, "to": 2, "delay": delay}]
        return Scenario(name="Far", agents=3, speedup=1, timeline=[ramp], network={"links": links})

    refuse_unsupported_network(scenario(2.0))
    with pytest.raises(
        MachineError,
        match=r"this kernel does not support .*--backend sim.*delay\.jitter_s from vehicle 1 to 2",
    ):
        refuse_unsupported_network(scenario(5.0))


def test_preflight_tests_links_that_differ_because_of_flight(netem: str, tmp_path: Path) -> None:
    twice = LinkConditions(duplicate=0.5)
    refused: list[EngineError] = []

    async def story(air: Air) -> None:
        try:
            await air.lab.apply(NetworkConditions(twice, links={(1, 2): replace(twice, loss=0.5)}))
        except EngineError as error:
            refused.append(error)

    in_lab([1, 2, 3], netem, tmp_path, story)
    flying = {"name": "Twice", "agents": 3, "speedup": 1, "network": {"duplicate": 0.5, "radio": {"hard_range": {}}}}
    with pytest.raises(MachineError, match="duplicat") if refused else nullcontext():
        refuse_unsupported_network(Scenario.model_validate(flying))


def test_preflight_refuses_unsupported_conditions_with_the_remedy(tmp_path: Path) -> None:
    needs = NetworkConditions(LinkConditions(delay=Delay(1)), {2: LinkConditions(corrupt=0.1)}).needs()

    async def story() -> None:
        with pytest.raises(LabUnavailable, match="Nothing does delay, receivers 2 corrupt here") as caught:
            await Lab.open([1, 2], engine="nftables", needs=needs, log=tmp_path / "lab.log")
        assert caught.value.stage == "engine"
        assert "nftables: supports only loss and partitions" in caught.value.reason
        assert "--backend sim" in caught.value.way_out

    play(story())
