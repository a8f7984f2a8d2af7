"""Test the shared radio channel with cases that can be calculated by hand, and with properties that always hold."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.channel import PRESETS, Channel, EndedTransmission, FrameFate, Radio, TimeSlotRadio, WifiRadio
from netem.radio import Place

WIFI_1 = PRESETS["wifi_1"]
QUIET = replace(WIFI_1, shadowing_db=0.0)
"""802.11 at 1 Mbit/s without shadowing. An answer of 47 bytes takes 1080 us, and the range is 461 m."""
ANSWER = 47
AIRTIME_S = 1080e-6
DIFS_S = 50e-6
LONG_AFTER = 100.0


def place(east_m: float, up_m: float = 0.0) -> Place:
    return Place(0.0, east_m, up_m)


def channel(radio: Radio, *metres: float, seed: int = 1) -> Channel:
    """Return a channel between vehicles on a line. The numbers are the distances of the vehicles from the beginning of
    the line, in metres.
    """
    made = Channel(range(1, len(metres) + 1), radio, seed)
    made.move([place(east_m) for east_m in metres], 0.0)
    return made


def sent(radio: Radio, metres: Sequence[float], *sends: tuple[int, float], seed: int = 1) -> list[EndedTransmission]:
    """Send answers, each given as (sender, seconds), and return all transmissions."""
    made = channel(radio, *metres, seed=seed)
    for sender, at_s in sends:
        assert isinstance(made.send(sender, at_s, ANSWER), int)
    return made.advance(LONG_AFTER)


@pytest.mark.parametrize(
    ("preset", "airtime_us"),
    [
        ("wifi_1", 192 + 8 * 111),
        ("wifi_6", 20 + 4 * 38 + 6),  # ceil((22 + 888) / 24) symbols
        ("wifi_11", 192 + 81),  # ceil(888 / 11) us
        ("rfd900", 1833 + 8 * 51 / 0.064),
        ("lora_sf7", 92_416),  # (8 + 4.25) + (8 + 14 * 5) symbols of 1.024 ms
        ("lora_sf12", 2_301_952),  # low data rate: (8 + 4.25) + (8 + 10 * 5) symbols of 32.768 ms
    ],
)
def test_airtime_of_47_bytes_follows_the_standards(preset: str, airtime_us: float) -> None:
    assert PRESETS[preset].airtime_ns(ANSWER) == round(1000 * airtime_us)


def test_lora_airtime_equals_the_calculator_of_semtech() -> None:
    # 20 bytes, SF7, 125 kHz, 4/5, explicit header, CRC, 8 preamble symbols: 56.58 ms; SF12: 1318.91 ms
    assert PRESETS["lora_sf7"].airtime_ns(20) == 56_576_000
    assert PRESETS["lora_sf12"].airtime_ns(20) == 1_318_912_000


def test_station_on_an_idle_channel_sends_at_once() -> None:
    (frame,) = sent(QUIET, [0, 100], (0, 1.0))
    assert (frame.queued_at, frame.began_at, frame.ended_at) == (1.0, 1.0, 1.0 + AIRTIME_S)
    assert frame.fate(1) is FrameFate.RECEIVED


def test_stations_that_start_in_the_same_slot_collide() -> None:
    first, second = sent(QUIET, [0, 100, 50], (0, 1.0), (1, 1.0))
    assert first.began_at == second.began_at
    assert first.lost() == {FrameFate.COLLISION: 0b100, FrameFate.HALF_DUPLEX: 0b010}
    assert second.lost() == {FrameFate.COLLISION: 0b100, FrameFate.HALF_DUPLEX: 0b001}


def test_station_that_senses_a_frame_waits_for_difs_and_its_backoff() -> None:
    starts = {sent(QUIET, [0, 10], (0, 1.0), (1, 1.0005), seed=seed)[1].began_at for seed in range(300)}
    allowed = {round(1.0 + AIRTIME_S + DIFS_S + slots * 20e-6, 9) for slots in range(32)}
    assert {round(start, 9) for start in starts} == allowed


def test_frame_that_began_too_recently_is_not_sensed() -> None:
    first, second = sent(QUIET, [0, 10], (0, 1.0), (1, 1.0 + 14e-6))
    assert second.began_at == 1.0 + 14e-6
    assert second.fate(0) is FrameFate.HALF_DUPLEX
    assert first.fate(1) is FrameFate.HALF_DUPLEX


def test_station_draws_a_backoff_after_its_own_frame() -> None:
    starts = {sent(QUIET, [0, 10], (0, 1.0), (0, 1.0))[1].began_at}
    starts |= {sent(QUIET, [0, 10], (0, 1.0), (0, 1.0), seed=seed)[1].began_at for seed in range(2, 200)}
    assert min(starts) == pytest.approx(1.0 + AIRTIME_S + DIFS_S, abs=1e-9)
    assert max(starts) == pytest.approx(1.0 + AIRTIME_S + DIFS_S + 31 * 20e-6, abs=1e-9)


def test_station_counts_down_after_its_frame_without_another_frame() -> None:
    _, second = sent(QUIET, [0, 10], (0, 1.0), (0, 1.0 + AIRTIME_S + DIFS_S + 31 * 20e-6))
    assert second.began_at == second.queued_at


def test_hidden_stations_collide_although_each_senses_an_idle_channel() -> None:
    first, second = sent(QUIET, [0, 380, 480], (0, 1.0), (2, 1.0005))
    assert second.began_at == second.queued_at
    assert first.fate(1) is FrameFate.COLLISION
    assert second.fate(1) is FrameFate.COLLISION
    assert first.fate(2) is FrameFate.RANGE


@pytest.mark.parametrize("seed", range(40))
def test_station_counts_no_slots_during_several_frames_of_others(seed: int) -> None:
    own = sent(QUIET, [0, 10], (0, 1.0), (0, 1.0001), seed=seed)
    slots_drawn = round((own[1].began_at - own[0].ended_at - DIFS_S) / 20e-6)
    traffic = ((0, 1.0), (1, 1.0001), (1, 1.0002))
    first, second, third = sent(QUIET, [0, 10], *traffic, seed=seed)
    passed = [second.began_at - first.ended_at, third.began_at - second.ended_at]
    slots_left = slots_drawn - sum(round((gap_s - DIFS_S) / 20e-6) for gap_s in passed)
    *_, last = sent(QUIET, [0, 10], *traffic, (0, third.began_at + 0.0005), seed=seed)
    if slots_left > 0:
        assert last.began_at == pytest.approx(third.ended_at + DIFS_S + slots_left * 20e-6, abs=1e-9)


def starts_between_two_frames(energy_dbm: float, seed: int) -> float:
    """Return the time at which station 2 begins a frame that it queues at 1.0005 s.

    Stations 0 and 1 are hidden from each other. Both begin a frame at 1 s. The frame of station 0 is much longer.
    Station 2 receives each frame with -80.1 dBm and both together with -77.1 dBm, and it can decode neither.
    """
    made = channel(replace(QUIET, energy_dbm=energy_dbm), 0, 800, 400, seed=seed)
    made.send(0, 1.0, 10 * ANSWER)
    made.send(1, 1.0, ANSWER)
    made.send(2, 1.0005, ANSWER)
    return next(frame.began_at for frame in made.advance(LONG_AFTER) if frame.sender == 2)


def test_station_senses_the_sum_of_frames_until_one_of_them_ends() -> None:
    starts = {round(starts_between_two_frames(-79.0, seed), 9) for seed in range(300)}
    assert starts == {round(1.0 + AIRTIME_S + DIFS_S + slots * 20e-6, 9) for slots in range(32)}


def test_station_sends_if_the_sum_of_frames_is_below_energy_detection() -> None:
    assert starts_between_two_frames(-76.0, 1) == pytest.approx(1.0005)


def test_stronger_frame_in_the_same_slot_is_captured() -> None:
    near, far = sent(QUIET, [0, 20, 400], (0, 1.0), (2, 1.0))
    assert near.fate(1) is FrameFate.RECEIVED
    assert far.fate(1) is FrameFate.COLLISION


def test_receiver_keeps_the_first_frame_after_the_capture_window() -> None:
    metres = [0, 380, 480]  # the second frame is 13.5 dB stronger at station 1
    _, late = sent(QUIET, metres, (0, 1.0), (2, 1.0005))
    assert late.fate(1) is FrameFate.COLLISION
    _, early = sent(replace(QUIET, capture_window_s=1e-3), metres, (0, 1.0), (2, 1.0005))
    assert early.fate(1) is FrameFate.RECEIVED


def test_frame_survives_a_weaker_one_that_begins_later() -> None:
    first, second = sent(QUIET, [0, 50, 480], (0, 1.0), (2, 1.0005))
    assert first.fate(1) is FrameFate.RECEIVED
    assert second.fate(1) is FrameFate.COLLISION


def test_sender_receives_nothing_while_it_sends() -> None:
    hidden_but_near = replace(QUIET, sense_s=0.01)  # senses frames too late
    first, second = sent(hidden_but_near, [0, 10], (0, 1.0), (1, 1.0005))
    assert first.fate(1) is FrameFate.HALF_DUPLEX
    assert second.fate(0) is FrameFate.HALF_DUPLEX


def test_full_queue_drops_messages() -> None:
    made = channel(replace(QUIET, queue_frames=2), 0, 10)
    answers = [made.send(0, 1.0, ANSWER) for _ in range(5)]
    assert answers == [0, 1, 2, FrameFate.QUEUE, FrameFate.QUEUE]  # while the first frame is sent
    assert made.send(0, 1.0 + AIRTIME_S + DIFS_S + 31 * 20e-6, ANSWER) == 3


def test_message_longer_than_a_frame_is_dropped() -> None:
    assert channel(QUIET, 0, 10).send(0, 1.0, 2305) is FrameFate.TOO_LONG
    assert channel(PRESETS["rfd900"], 0, 10).send(0, 1.0, 753) is FrameFate.TOO_LONG
    assert channel(PRESETS["lora_sf7"], 0, 10).send(0, 1.0, 256) is FrameFate.TOO_LONG


def test_lora_station_keeps_its_duty_cycle() -> None:
    frames = sent(PRESETS["lora_sf7"], [0, 100], (0, 1.0), (0, 1.0), (0, 1.0))
    starts = [frame.began_at for frame in frames]
    assert starts == pytest.approx([1.0, 1.0 + 9.2416, 1.0 + 2 * 9.2416], abs=1e-9)


def test_telemetry_radios_send_in_turns_and_never_collide() -> None:
    radio = PRESETS["rfd900"]
    assert isinstance(radio, TimeSlotRadio)
    frames = sent(radio, [0, 10, 20], (0, 0.05), (1, 0.05), (2, 0.05), (2, 0.06))
    assert [frame.sender for frame in frames] == [0, 1, 2, 2]
    assert [frame.began_at for frame in frames[:3]] == pytest.approx([0.05, 0.1037, 0.2074], abs=1e-9)
    assert all(not frame.lost() for frame in frames)


def test_partition_puts_vehicles_on_different_channels() -> None:
    made = channel(QUIET, 0, 10, 20, 30)
    made.tune([0, 0, 1, 1], 0.5)
    made.send(0, 1.0, ANSWER)
    made.send(2, 1.0005, ANSWER)
    first, second = made.advance(LONG_AFTER)
    assert (first.fate(1), first.fate(2)) == (FrameFate.RECEIVED, FrameFate.PARTITION)
    assert (second.fate(3), second.fate(0)) == (FrameFate.RECEIVED, FrameFate.PARTITION)
    assert second.began_at == 1.0005


def test_antenna_at_half_a_metre_halves_the_range() -> None:
    grounded = replace(QUIET, ground="two_ray", antenna_m=0.5)
    assert sent(QUIET, [0, 400], (0, 1.0))[0].fate(1) is FrameFate.RECEIVED
    assert sent(grounded, [0, 170], (0, 1.0))[0].fate(1) is FrameFate.RECEIVED
    assert sent(grounded, [0, 190], (0, 1.0))[0].fate(1) is FrameFate.RANGE
    made = Channel((1, 2), grounded, 1)
    made.move([place(0, 30.0), place(400, 30.0)], 0.0)
    made.send(0, 1.0, ANSWER)
    assert made.advance(2.0)[0].fate(1) is FrameFate.RECEIVED


def test_shadowing_is_the_same_shortly_afterwards_and_in_both_directions() -> None:
    edge = [0, 461]  # the shadowing alone decides
    fates = set()
    for seed in range(50):
        near_in_time = sent(replace(WIFI_1, shadowing_s=1e6), edge, (0, 1.0), (1, 2.0), (0, 3.0), seed=seed)
        there, back, again = (frame.received for frame in near_in_time)
        assert bool(there) == bool(back) == bool(again)
        fates.add(there)
    assert len(fates) == 2


def test_shadowing_without_correlation_is_drawn_for_each_frame() -> None:
    sends = [(0, 1.0 + 0.1 * number) for number in range(200)]
    radio = replace(WIFI_1, shadowing_s=0.0, queue_frames=1000)
    received = sum(frame.received >> 1 for frame in sent(radio, [0, 461], *sends))
    assert 60 < received < 140


def test_shadowing_changes_with_the_distance_that_a_vehicle_moves() -> None:
    changes = 0
    for seed in range(100):
        made = Channel((1, 2), replace(WIFI_1, shadowing_s=1e9), seed)
        fates = []
        for step in range(2):
            made.move([place(0), place(461.0 * (1 - 2 * step))], step)
            made.send(0, step + 0.5, ANSWER)
            fates.append(made.advance(step + 0.9)[0].received)
        changes += fates[0] != fates[1]
    assert 25 < changes < 75


SENDS = st.lists(
    st.tuples(st.integers(0, 4), st.floats(0, 0.05), st.integers(1, 300)), min_size=1, max_size=40
)  # (sender, seconds, bytes)


def played(preset: str, sends: Sequence[tuple[int, float, int]], steps: int) -> list[tuple[object, ...]]:
    made = channel(PRESETS[preset], 0, 30, 200, 420, 800)
    found: list[EndedTransmission] = []
    for sender, at_s, data_bytes in sorted(sends, key=lambda send: send[1]):
        made.send(sender, at_s, data_bytes)
        if steps:
            found += made.advance(at_s)
    while (at := made.next_event()) is not None:
        found += made.advance(at if steps else 1e6)
    return [(frame.number, frame.sender, frame.began_at, frame.ended_at, frame.lost()) for frame in found]


@given(st.sampled_from(sorted(PRESETS)), SENDS)
def test_result_does_not_depend_on_when_the_caller_advances(preset: str, sends: list[tuple[int, float, int]]) -> None:
    assert played(preset, sends, steps=0) == played(preset, sends, steps=1)


@given(st.sampled_from(sorted(PRESETS)), SENDS)
def test_each_receiver_has_one_fate_and_no_station_sends_twice_at_a_time(
    preset: str, sends: list[tuple[int, float, int]]
) -> None:
    made = channel(PRESETS[preset], 0, 30, 200, 420, 800)
    queued = [made.send(sender, at_s, size) for sender, at_s, size in sorted(sends, key=lambda send: send[1])]
    frames = made.advance(1e6)
    assert sorted(frame.number for frame in frames) == [number for number in queued if isinstance(number, int)]
    assert made.next_event() is None
    last_end = dict.fromkeys(range(5), 0.0)
    for frame in sorted(frames, key=lambda frame: frame.began_at):
        receivers = [frame.received, *frame.lost().values()]
        assert sum(receivers) == 0b11111 - (1 << frame.sender)
        assert frame.began_at >= max(frame.queued_at, last_end[frame.sender])
        assert frame.ended_at == pytest.approx(frame.began_at + PRESETS[preset].airtime_ns(frame.data_bytes) / 1e9)
        last_end[frame.sender] = frame.ended_at


def test_more_frames_than_the_channel_carries_are_dropped_or_collide() -> None:
    radio = PRESETS["wifi_1"]
    assert isinstance(radio, WifiRadio)
    made = channel(radio, 0, 10, 20, 30, 40)
    answers = [made.send(number % 5, number * 1e-4, ANSWER) for number in range(2000)]
    drops = answers.count(FrameFate.QUEUE)
    assert drops > 1500
    assert len(made.advance(LONG_AFTER)) == 2000 - drops
