"""Test the effect of conditions on real packets, with both engines, and the counters of the kernel."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import pytest

from netem import addresses
from netem.conditions import LinkConditions, NetworkConditions
from netem.errors import ConditionsError
from netem.lab import Lab
from tests.netem.conftest import DEADLINE_S, PACKETS, PORT, Air, assert_binomial, play

pytestmark = pytest.mark.lab

ETHERTYPES = {"0800": "IPv4", "0806": "ARP", "86dd": "IPv6", "88b5": "none that anybody knows"}
EVERYONE = "ff:ff:ff:ff:ff:ff"
MULTICAST = "01:00:5e:00:00:fb"


def in_lab(vehicles: Sequence[int], engine: str, folder: Path, story: Callable[[Air], Awaitable[None]]) -> None:
    async def run() -> None:
        async with await Lab.open(vehicles, engine=engine, log=folder / "lab.log") as lab:  # type: ignore[arg-type]
            assert lab.engine == engine
            await story(Air(lab, folder))

    play(run())


def loss(default: float, **receivers: float) -> NetworkConditions:
    """Return network conditions. For example, loss(0.1, v3=0.5) means a loss rate of 0.1, and of 0.5 at vehicle 3."""
    links = {int(name[1:]): LinkConditions(value) for name, value in receivers.items()}
    return NetworkConditions(LinkConditions(default), links)


async def deliveries(air: Air, sender: int, receivers: Sequence[int], count: int) -> dict[int, set[int]]:
    """Broadcast `count` numbered datagrams. Return the numbers of the datagrams that each receiver received."""
    listeners = {vehicle: await air.start_ready(vehicle, "receive", PORT) for vehicle in receivers}
    await air.broadcast(sender, count)
    heard = {vehicle: await listener.finish() for vehicle, listener in listeners.items()}
    assert all(result["overflow"] == 0 for result in heard.values()), "a receiver was too slow to judge by"
    for result in heard.values():
        assert len(result["numbers"]) == len(set(result["numbers"])), "a datagram came twice"
    return {vehicle: set(result["numbers"]) for vehicle, result in heard.items()}


def test_broadcasts_without_conditions_reach_all_vehicles(engine: str, tmp_path: Path) -> None:
    async def story(air: Air) -> None:
        got = await deliveries(air, 1, [2, 300, 65535], 200)
        assert got == {vehicle: set(range(200)) for vehicle in (2, 300, 65535)}

    in_lab([1, 2, 300, 65535], engine, tmp_path, story)


def test_loss_per_receiver_is_as_requested_and_independent(engine: str, tmp_path: Path) -> None:
    asked = {2: 0.15, 3: 0.15, 4: 0.5, 5: 0.0, 6: 1.0}

    async def story(air: Air) -> None:
        applied = await air.lab.apply(loss(0.15, v4=0.5, v5=0.0, v6=1.0))
        assert {v: applied.receivers[v].loss for v in asked} == asked
        got = await deliveries(air, 1, list(asked), PACKETS)
        lost = {vehicle: set(range(PACKETS)) - numbers for vehicle, numbers in got.items()}
        assert not lost[5]
        assert not got[6]
        for vehicle in (2, 3, 4):
            assert_binomial(len(lost[vehicle]), PACKETS, asked[vehicle])
        for one, other in ((2, 3), (2, 4), (3, 4)):
            assert_binomial(len(lost[one] & lost[other]), PACKETS, asked[one] * asked[other])
        # The kernel counted the same packets as the receivers.
        figures = (await air.lab.read()).receivers
        for vehicle in asked:
            assert (figures[vehicle].passed, figures[vehicle].lost) == (len(got[vehicle]), len(lost[vehicle]))

    in_lab([1, 2, 3, 4, 5, 6], engine, tmp_path, story)


async def crossings(air: Air, vehicles: Sequence[int]) -> set[tuple[int, int, str]]:
    """Send all kinds of frames to all kinds of destinations. Return (sender, receiver, kind) for each frame that
    arrived.
    """
    listeners = {vehicle: await air.start_ready(vehicle, "listen") for vehicle in vehicles}
    for sender in vehicles:
        destinations = [EVERYONE, MULTICAST, *(addresses.mac(v) for v in vehicles if v != sender)]
        await air.run(sender, "frames", ",".join(destinations), *ETHERTYPES)
    heard: set[tuple[int, int, str]] = set()
    names = {addresses.mac(vehicle): vehicle for vehicle in vehicles}
    for receiver, listener in listeners.items():
        for mac, kinds in (await listener.finish())["frames"].items():
            heard |= {(names[mac], receiver, kind) for kind in kinds if mac != addresses.mac(receiver)}
    return heard


def all_of(pairs: Sequence[tuple[int, int]]) -> set[tuple[int, int, str]]:
    return {(a, b, kind) for one, other in pairs for a, b in ((one, other), (other, one)) for kind in ETHERTYPES}


def test_nothing_crosses_a_partition_and_healing_restores_everything(engine: str, tmp_path: Path) -> None:
    async def story(air: Air) -> None:
        lab = air.lab
        applied = await lab.apply(NetworkConditions().with_partition([[1, 2]]))
        assert {v: set(f.cut_from) for v, f in applied.receivers.items()} == {
            1: {3, 4},
            2: {3, 4},
            3: {1, 2},
            4: {1, 2},
        }
        assert await crossings(air, [1, 2, 3, 4]) == all_of([(1, 2), (3, 4)])
        before = await lab.read()
        assert all(figures.cut > 0 and figures.lost == 0 for figures in before.receivers.values())
        # Other groups. One vehicle stays in its group, and one is alone.
        await lab.apply(NetworkConditions().with_partition([[1, 3, 4], [2]]))
        assert await crossings(air, [1, 2, 3, 4]) == all_of([(1, 3), (1, 4), (3, 4)])
        applied = await lab.apply(NetworkConditions())
        assert not any(figures.cut_from for figures in applied.receivers.values())
        assert await crossings(air, [1, 2, 3, 4]) == all_of([(1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4)])

    in_lab([1, 2, 3, 4], engine, tmp_path, story)


def test_partition_cuts_every_protocol_in_both_directions_at_once(engine: str, tmp_path: Path) -> None:
    took_ns: list[tuple[int, int]] = []

    async def story(air: Air) -> None:
        lab = air.lab
        conditions = loss(0.0)
        listeners = [await air.start_ready(vehicle, "listen") for vehicle in lab.vehicles]
        streams = [await air.start_ready(vehicle, "stream", *ETHERTYPES) for vehicle in lab.vehicles]
        rounds = []
        for _ in range(5):
            asked_ns = time.time_ns()
            await lab.apply(conditions.with_partition([[1]]))
            cut_ns = time.time_ns()
            await asyncio.sleep(0.2)
            heal_ns = time.time_ns()
            await lab.apply(conditions)
            rounds.append((asked_ns, cut_ns, heal_ns, time.time_ns()))
            await asyncio.sleep(0.2)
        for stream in streams:
            await stream.process.terminate(DEADLINE_S)
        heard = [(await listener.finish())["times_ns"] for listener in listeners]
        for receiver, sender in ((1, 2), (2, 1)):
            times = heard[receiver - 1][addresses.mac(sender)]
            assert times.keys() == ETHERTYPES.keys()
            for index, (asked_ns, cut_ns, heal_ns, healed_ns) in enumerate(rounds):
                # a busy machine may stop a sender between its timestamp and the sending
                held = [
                    at_ns for kind in times.values() for at_ns, came_ns in kind if cut_ns < at_ns < heal_ns <= came_ns
                ]
                assert len(held) <= 1, "frames were kept until the partition was over"
                for frames in times.values():
                    assert not any(cut_ns < at_ns <= came_ns < heal_ns for at_ns, came_ns in frames), (
                        "crossed a partition"
                    )
                    end_ns = rounds[index + 1][0] if index + 1 < len(rounds) else healed_ns + 200_000_000
                    assert any(healed_ns < at_ns < end_ns for at_ns, _ in frames), "nothing came after healing"
                    before = [at_ns for at_ns, came_ns in frames if came_ns < heal_ns]
                    took_ns.append((index, max(before, default=0) - asked_ns))

    in_lab([1, 2], engine, tmp_path, story)
    # The machine may be busy during one command, but not during every command.
    slowest = {index: max(took for other, took in took_ns if other == index) for index, _ in took_ns}
    assert min(slowest.values()) <= 50_000_000, f"packets crossed until {min(slowest.values()) / 1e6} ms later"


def test_each_direction_of_each_pair_has_its_own_loss(engine: str, tmp_path: Path) -> None:
    asked = {(1, 2): 0.5, (2, 1): 0.1, (1, 3): 1.0, (3, 1): 0.0}

    async def story(air: Air) -> None:
        links = {pair: LinkConditions(share) for pair, share in asked.items()}
        conditions = NetworkConditions(LinkConditions(0.3), {1: LinkConditions(0.2)}, links)
        applied = await air.lab.apply(conditions)
        for sender, receiver in itertools.permutations(air.lab.vehicles, 2):
            assert applied.receivers[receiver].from_sender(sender).loss == conditions.link(sender, receiver).loss
        lost = dict.fromkeys(air.lab.vehicles, 0)
        for sender in air.lab.vehicles:
            others = [vehicle for vehicle in air.lab.vehicles if vehicle != sender]
            got = await deliveries(air, sender, others, PACKETS)
            for receiver, numbers in got.items():
                missing = PACKETS - len(numbers)
                assert_binomial(missing, PACKETS, conditions.link(sender, receiver).independent_loss)
                lost[receiver] += missing
        figures = (await air.lab.read()).receivers
        assert {vehicle: figures[vehicle].lost for vehicle in lost} == lost
        assert all(figures[vehicle].passed == 3 * PACKETS - lost[vehicle] for vehicle in lost)
        # Back to common conditions, with a temporary partition.
        await air.lab.apply(conditions.with_partition([[1, 2], [3]]))
        applied = await air.lab.apply(loss(0.0))
        assert not any(figures.links for figures in applied.receivers.values())
        assert (await deliveries(air, 1, [2, 3, 4], 100)) == {vehicle: set(range(100)) for vehicle in (2, 3, 4)}

    in_lab([1, 2, 3, 4], engine, tmp_path, story)


def test_hundred_vehicles_get_conditions_for_each_pair(engine: str, tmp_path: Path) -> None:
    vehicles = range(1, 101)
    random = Random(1)
    pairs = {pair: LinkConditions(round(random.random(), 6)) for pair in itertools.permutations(vehicles, 2)}

    async def story(air: Air) -> None:
        conditions = NetworkConditions(links=pairs)
        applied = await air.lab.apply(conditions)
        for (sender, receiver), link in pairs.items():
            assert applied.receivers[receiver].from_sender(sender).loss == pytest.approx(link.loss, abs=2e-9)
        applied = await air.lab.apply(conditions.with_partition([range(1, 51)]))
        assert applied.receivers[1].cut_from == tuple(range(51, 101))

    in_lab(vehicles, engine, tmp_path, story)


def test_partition_does_not_change_the_loss_inside_its_groups(engine: str, tmp_path: Path) -> None:
    async def story(air: Air) -> None:
        conditions = loss(0.3).with_partition([[1, 2], [3]])
        applied = await air.lab.apply(conditions)
        assert all(figures.loss == 0.3 for figures in applied.receivers.values())
        got = await deliveries(air, 1, [2, 3], PACKETS)
        assert not got[3]
        assert_binomial(PACKETS - len(got[2]), PACKETS, 0.3)
        figures = (await air.lab.read()).receivers
        assert (figures[3].passed, figures[3].lost, figures[3].cut) == (0, 0, PACKETS)

    in_lab([1, 2, 3], engine, tmp_path, story)


def test_change_of_conditions_during_traffic_keeps_the_counts(engine: str, tmp_path: Path) -> None:
    count = PACKETS

    async def story(air: Air) -> None:
        lab = air.lab
        listener = await air.start_ready(2, "receive", PORT)
        sender = await air.start(1, "broadcast", PORT, count, 0, lab.broadcast)
        changes: list[NetworkConditions] = [
            loss(0.1), loss(0.1).with_partition([[1], [2, 3]]), loss(0.9), loss(0.0).with_partition([[3]]), loss(0.0)
        ]  # fmt: skip
        rounds = 0
        seen = 0
        while sender.process.returncode is None or rounds < len(changes):
            applied = await lab.apply(changes[rounds % len(changes)])
            figures = applied.receivers[2]
            now = figures.passed + figures.lost + figures.cut
            assert now >= seen, "a change made the kernel forget what it had counted"
            seen = now
            rounds += 1
        assert await sender.process.wait() == 0
        got = (await listener.finish())["numbers"]
        figures = (await lab.read()).receivers[2]
        assert figures.passed == len(got)
        assert figures.passed + figures.lost + figures.cut == count
        assert len(got) == len(set(got))

    in_lab([1, 2, 3], engine, tmp_path, story)


def test_unknown_vehicle_is_refused_and_the_old_conditions_stay(engine: str, tmp_path: Path) -> None:
    async def story(air: Air) -> None:
        before = await air.lab.apply(loss(0.25))
        with pytest.raises(ConditionsError, match="unknown vehicle 9"):
            await air.lab.apply(NetworkConditions().with_partition([[9]]))
        assert await air.lab.read() == before

    in_lab([1, 2], engine, tmp_path, story)


@pytest.mark.parametrize("tiny", [1e-12, 1 - 1e-12])
def test_loss_between_0_and_1_is_not_rounded_to_0_or_1(engine: str, tmp_path: Path, tiny: float) -> None:
    async def story(air: Air) -> None:
        applied = await air.lab.apply(loss(tiny))
        assert applied.receivers[1].loss == pytest.approx(tiny, abs=1e-9)
        got = await deliveries(air, 1, [2], 100)
        assert len(got[2]) == (100 if tiny < 0.5 else 0)

    in_lab([1, 2], engine, tmp_path, story)


def test_figures_survive_json(engine: str, tmp_path: Path) -> None:
    async def story(air: Air) -> None:
        applied = await air.lab.apply(loss(0.25).with_partition([[1]]))
        figures: dict[str, Any] = applied.to_json()
        assert figures["engine"] == engine
        assert figures["receivers"]["1"] == {"loss": 0.25, "cut_from": (2,), "passed": 0, "lost": 0, "cut": 0}
        assert type(applied).from_json(figures) == applied

    in_lab([1, 2], engine, tmp_path, story)
