"""Test packet captures of a virtual network: each file contains all frames of its vehicle and no others."""

import asyncio
import signal
import struct
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

import pytest
from scapy.layers.inet import IP, UDP
from scapy.layers.l2 import Ether

from netem.capture import LiveCapture, begin_file
from netem.conditions import Delay, LinkConditions, NetworkConditions
from netem.errors import LiveCaptureError
from netem.lab import Lab
from tests.captured import comment, frames, statistics
from tests.netem.conftest import DEADLINE_S, PACKETS, PORT, Air, assert_binomial, play

pytestmark = pytest.mark.lab

EVERYONE = "ff:ff:ff:ff:ff:ff"
Story = Callable[[Air, LiveCapture], Awaitable[None]]


def capture(vehicles: Sequence[int], folder: Path, story: Story, engine: str | None = None) -> None:
    """Run a test in a virtual network while its packets are captured."""

    async def run() -> None:
        async with await Lab.open(vehicles, engine=engine, log=folder / "lab.log") as lab:  # type: ignore[arg-type]
            capture = await LiveCapture.start(lab, folder)
            await capture.begin(time.time_ns() // 1000, 20)
            await story(Air(lab, folder), capture)

    play(run())


def numbers(folder: Path, vehicle: int, *, outbound: bool) -> list[int]:
    """Return the numbers that `netem._probe` gave to the datagrams."""
    found = frames(folder / f"{vehicle}.pcapng")
    return [struct.unpack_from("!I", frame.payload)[0] for frame in found if frame.outbound == outbound]


def with_checksums_anew(data: bytes) -> Ether:
    frame = Ether(data)
    assert len(frame[UDP].payload) in (12, 13, 1472)
    del frame[IP].chksum, frame[UDP].chksum
    return frame


def test_capture_at_10_000_packets_a_second_has_every_frame(tmp_path: Path) -> None:
    count = 5 * PACKETS
    vehicles = [1, 2, 300, 65535]

    async def story(air: Air, capture: LiveCapture) -> None:
        await asyncio.gather(*(air.broadcast(vehicle, count, count * vehicle, 600) for vehicle in (1, 2)))
        assert await capture.stop() == {vehicle: {"received": 2 * count, "dropped": 0} for vehicle in vehicles}

    capture(vehicles, tmp_path, story)
    said = {vehicle: list(range(count * vehicle, count * (vehicle + 1))) for vehicle in (1, 2)}
    for vehicle in vehicles:
        others = [number for sender in (1, 2) if sender != vehicle for number in said[sender]]
        assert numbers(tmp_path, vehicle, outbound=True) == said.get(vehicle, [])
        assert sorted(numbers(tmp_path, vehicle, outbound=False)) == others
        assert statistics(tmp_path / f"{vehicle}.pcapng") == {"received": 2 * count, "dropped": 0}


def test_lost_and_cut_frames_are_only_in_the_file_of_their_sender(engine: str, tmp_path: Path) -> None:
    async def story(air: Air, capture: LiveCapture) -> None:
        conditions = NetworkConditions(receivers={2: LinkConditions(0.3)}).with_partition([[4]])
        await air.lab.apply(conditions)
        listeners = {vehicle: await air.start_ready(vehicle, "receive", PORT) for vehicle in (2, 3, 4)}
        await air.broadcast(1, PACKETS)
        heard = {vehicle: await listener.finish() for vehicle, listener in listeners.items()}
        counted = (await air.lab.read()).receivers
        await capture.stop()
        assert numbers(tmp_path, 1, outbound=True) == list(range(PACKETS))
        for vehicle in (2, 3, 4):
            assert heard[vehicle]["overflow"] == 0
            assert numbers(tmp_path, vehicle, outbound=False) == heard[vehicle]["numbers"]
            assert len(heard[vehicle]["numbers"]) == counted[vehicle].passed
        assert_binomial(counted[2].passed, PACKETS, 0.7)
        assert counted[3].passed == PACKETS
        assert counted[4].cut == PACKETS

    capture([1, 2, 3, 4], tmp_path, story, engine)


def test_file_of_the_receiver_has_duplicates_and_delays(netem: str, tmp_path: Path) -> None:
    delay_s, count = 0.3, 200

    async def story(air: Air, capture: LiveCapture) -> None:
        late, twice = LinkConditions(delay=Delay(delay_s)), LinkConditions(duplicate=1.0)
        await air.lab.apply(NetworkConditions(receivers={2: late, 3: twice}))
        await air.broadcast(1, count)
        await asyncio.sleep(2 * delay_s)
        await capture.stop()

    capture([1, 2, 3], tmp_path, story, netem)
    sent = [frame.at_ns for frame in frames(tmp_path / "1.pcapng")]
    came = [frame.at_ns for frame in frames(tmp_path / "2.pcapng")]
    assert len(sent) == len(came) == count
    assert all(after - before >= delay_s * 1e9 for before, after in zip(sent, came, strict=True))
    assert sorted(numbers(tmp_path, 3, outbound=False)) == sorted([*range(count), *range(count)])
    assert numbers(tmp_path, 1, outbound=True) == list(range(count))


def test_frames_are_complete_with_checksums_and_vlan_tags(tmp_path: Path) -> None:
    tagged = "8100600588b5"

    async def story(air: Air, capture: LiveCapture) -> None:
        for size in (12, 13, 1472):
            await air.broadcast(258, 3, size=size)
        await air.run(258, "frames", EVERYONE, tagged, "0800")
        await capture.stop()

    before_us = time.time_ns() // 1000
    capture([258, 7], tmp_path, story)
    sent, came = (frames(tmp_path / f"{vehicle}.pcapng") for vehicle in (258, 7))
    assert [frame.data for frame in sent] == [frame.data for frame in came]
    assert {(one.outbound, other.outbound) for one, other in zip(sent, came, strict=True)} == {(True, False)}
    *datagrams, with_tag, without = sent
    for frame in datagrams:
        assert frame.data == bytes(with_checksums_anew(frame.data))
    assert with_tag.data[12:18].hex() == tagged
    assert len(with_tag.data) == len(without.data) + 4
    about = comment(tmp_path / "7.pcapng")
    assert before_us <= about.pop("epoch_us") <= min(frame.at_ns for frame in sent) // 1000
    assert about == {"ucp_harness": 1, "vehicle": 7, "speedup": 20.0}


def test_slow_capture_reports_the_number_of_missing_frames(tmp_path: Path) -> None:
    count = 15_000  # number of largest datagrams: more than a ring can hold

    async def story(air: Air, capture: LiveCapture) -> None:
        await capture._process.send_signal(signal.SIGSTOP)
        await air.broadcast(1, count, size=1472)
        await capture._process.send_signal(signal.SIGCONT)
        counted = await capture.stop()
        for vehicle in (1, 2):
            assert counted[vehicle]["received"] == count
            assert 0 < counted[vehicle]["dropped"] < count
            assert len(frames(tmp_path / f"{vehicle}.pcapng")) == count - counted[vehicle]["dropped"]
            assert statistics(tmp_path / f"{vehicle}.pcapng") == counted[vehicle]

    capture([1, 2], tmp_path, story)


def test_capture_that_ends_early_is_an_error_and_keeps_its_frames(tmp_path: Path) -> None:
    async def story(air: Air, capture: LiveCapture) -> None:
        await air.broadcast(1, 100)
        watched = asyncio.create_task(capture.watch())

        def captured() -> list[int]:
            return [len(frames(tmp_path / f"{vehicle}.pcapng")) for vehicle in (1, 2)]

        deadline = time.monotonic() + 3 * DEADLINE_S  # a lab in User Mode Linux on a busy machine takes its time
        while captured() != [100, 100]:
            assert time.monotonic() < deadline, f"{captured()} of 100 frames each"
            await asyncio.sleep(0.01)
        await capture._process.send_signal(signal.SIGKILL)
        for failed in (watched, capture.stop()):
            with pytest.raises(LiveCaptureError, match="The capture of packets failed: SIGKILL"):
                await failed
        assert captured() == [100, 100]

    capture([1, 2], tmp_path, story)


def test_capture_that_gets_sigterm_first_has_every_frame(tmp_path: Path) -> None:
    async def story() -> None:
        async with await Lab.open([1, 2], log=tmp_path / "lab.log") as lab:
            capture = await LiveCapture.start(lab, tmp_path)
            await Air(lab, tmp_path).broadcast(1, 100)
            for vehicle in (1, 2):
                begin_file(tmp_path, vehicle, time.time_ns() // 1000, 20)
            assert await capture.stop() == {vehicle: {"received": 100, "dropped": 0} for vehicle in (1, 2)}

    play(story())
    assert [len(frames(tmp_path / f"{vehicle}.pcapng")) for vehicle in (1, 2)] == [100, 100]


def test_capture_of_a_mission_that_never_began_leaves_no_files(tmp_path: Path) -> None:
    async def story() -> None:
        async with await Lab.open([1, 2], log=tmp_path / "lab.log") as lab:
            assert await (await LiveCapture.start(lab, tmp_path)).stop() == {}

    play(story())
    assert not list(tmp_path.glob("*.pcapng"))


def test_failed_start_of_a_capture_gives_the_reason(tmp_path: Path) -> None:
    async def story() -> None:
        async with await Lab.open([1, 2], log=tmp_path / "lab.log") as lab:
            lab.vehicles = (1, 2, 3)
            with pytest.raises(LiveCaptureError, match="The capture of packets failed: No such device"):
                await LiveCapture.start(lab, tmp_path)

    play(story())
