"""Test the shared radio channel in real time. The tests set the time."""

from dataclasses import replace
from typing import Any

import pytest

from harness.play.process._channel_node import AnswerTimeMeter, DeliveryLateness
from harness.play.process._live_channel import LiveChannel
from netem.channel import PRESETS
from netem.conditions import Delay, LinkConditions, NetworkConditions
from netem.frames import udp_broadcast
from netem.radio import Place
from netem.relay import ReceivedBroadcast
from ucp.messages import PORT, BlockAddRequest, BlockAddResponse, Message, encode

DATA_BYTES = 47
RADIO = replace(PRESETS["wifi_1"], shadowing_db=0.0)
AIRTIME_S = RADIO.airtime_ns(DATA_BYTES) / 1e9
HERE = Place(0.0, 0.0, 10.0)
FAR = Place(5000.0, 0.0, 10.0)


class Played:
    """A radio channel between vehicles 1, 2 and 3, and the log of the channel."""

    def __init__(self, processing_s: float = 0.0) -> None:
        self.journal: list[dict[str, Any]] = []
        self.channel = LiveChannel((1, 2, 3), RADIO, processing_s, 1, self.journal.append)

    def send(self, at_s: float, vehicle: int, sequence: int | None = 0) -> None:
        self.channel.send(at_s, vehicle, b"%d" % vehicle, DATA_BYTES, sequence)

    def arrivals(self, now: float) -> list[tuple[float, int, bytes]]:
        return [(round(due.at_s, 9), due.vehicle, due.frame) for due in self.channel.advance(now)]


def test_message_arrives_at_the_end_of_its_frame() -> None:
    played = Played()
    played.send(1.0, 2)
    assert played.arrivals(1.0) == []
    assert played.channel.next_s == pytest.approx(1.0 + AIRTIME_S)
    assert played.arrivals(1.0 + 0.99 * AIRTIME_S) == []
    ends_s = round(1.0 + AIRTIME_S, 9)
    assert played.arrivals(2.0) == [(ends_s, 1, b"2"), (ends_s, 3, b"2")]
    assert played.channel.next_s == float("inf")
    assert [(line["sender"], line["sequence"], line["lost"]) for line in played.journal] == [(2, 0, {})]


def test_late_caller_changes_no_decision() -> None:
    def outcome(steps: list[float]) -> list[tuple[float, int, bytes]]:
        played = Played(processing_s=0.005)
        arrivals = []
        sent = [(number * 0.003, number % 3 + 1) for number in range(60)]
        for now in steps:
            while sent and sent[0][0] <= now:
                played.send(*sent.pop(0))
            arrivals += played.arrivals(now)
        return arrivals

    punctual = outcome([number / 10_000 for number in range(3000)])
    assert len(punctual) > 60
    assert outcome([0.001, 0.08, 0.081, 0.3]) == punctual


def test_messages_that_begin_at_once_collide() -> None:
    played = Played()
    played.send(1.0, 1)
    played.send(1.0, 2)
    assert played.arrivals(2.0) == []
    assert [line["lost"] for line in played.journal] == [
        {"collision": [3], "half_duplex": [2]},
        {"collision": [3], "half_duplex": [1]},
    ]
    assert played.channel.totals.to_json()["lost"] == {"collision": {"3": 2}, "half_duplex": {"1": 1, "2": 1}}


def test_partition_separates_the_channels() -> None:
    played = Played()
    played.channel.apply(NetworkConditions(partition=(frozenset({1}),)), 0.5)
    played.send(1.0, 2)
    assert [vehicle for _, vehicle, _ in played.arrivals(2.0)] == [3]
    assert played.journal[0]["lost"] == {"partition": [1]}


def test_vehicle_out_of_range_hears_nothing_until_it_returns() -> None:
    played = Played()
    played.channel.move([FAR, HERE, HERE], 0.5)
    played.send(1.0, 2)
    assert [vehicle for _, vehicle, _ in played.arrivals(2.0)] == [3]
    assert played.journal[0]["lost"] == {"range": [1]}
    played.channel.move([HERE, HERE, HERE], 2.0)
    played.send(2.5, 2)
    assert [vehicle for _, vehicle, _ in played.arrivals(3.0)] == [1, 3]


def test_conditions_apply_to_delivered_copies() -> None:
    played = Played()
    slow = LinkConditions(delay=Delay(0.5), duplicate=1.0)
    played.channel.apply(NetworkConditions(links={(2, 1): slow, (2, 3): LinkConditions(loss=1.0)}), 0.5)
    played.send(1.0, 2)
    assert played.arrivals(1.4) == []
    assert [(at_s, vehicle) for at_s, vehicle, _ in played.arrivals(2.0)] == [(round(1.5 + AIRTIME_S, 9), 1)] * 2
    assert played.journal[0]["lost"] == {}


def test_other_broadcast_does_not_use_the_channel() -> None:
    played = Played()
    played.channel.apply(NetworkConditions(partition=(frozenset({1}),)), 0.5)
    played.channel.pass_by(1.0, 2, b"arp")
    assert played.arrivals(1.0) == [(1.0, 3, b"arp")]
    assert played.channel.totals.frames == 0


def test_message_received_after_its_time_is_sent_at_once() -> None:
    played = Played()
    assert played.arrivals(1.0) == []
    played.send(0.9, 2)
    assert [at_s for at_s, _, _ in played.arrivals(2.0)] == [round(1.0 + AIRTIME_S, 9)] * 2


def test_lateness_has_quantiles_and_intervals() -> None:
    lateness = DeliveryLateness()
    for number in range(100):
        lateness.add(0.5 if number < 50 else 1.5, (0.5 if number < 50 else 1.5) + number / 1000)
    figures = lateness.to_json()["lateness"]
    assert figures["deliveries"] == 100
    assert figures["median_s"] == pytest.approx(0.05, abs=1e-4)
    assert figures["p95_s"] == pytest.approx(0.095, abs=1e-4)
    assert figures["most_s"] == pytest.approx(0.099, abs=1e-4)
    assert figures["by_interval_s"] == [0.049, 0.099]


def heard(vehicle: int, message: Message) -> tuple[ReceivedBroadcast, bytes]:
    """Return a broadcast that contains this message, and its data."""
    data = encode(vehicle, 7, message)
    return ReceivedBroadcast(vehicle, 0, bytes(10) + udp_broadcast(vehicle, PORT, data)), data


def test_answer_times_are_measured_from_the_delivery_of_the_question() -> None:
    times = AnswerTimeMeter()
    question, asked = heard(1, BlockAddRequest(bytes(32), bytes(32)))
    answer, answered = heard(2, BlockAddResponse(bytes(32), True))
    times.sent(answer, answered, 0.5)
    times.sent(question, asked, 1.0)
    times.delivered(question.frame, 2, 1.1)
    times.delivered(answer.frame, 2, 1.15)
    times.sent(answer, answered, 1.3)
    times.sent(answer, answered, 1.6)
    assert times.to_json() == {"answers": {"count": 1, "median_s": pytest.approx(0.2), "p95_s": pytest.approx(0.2)}}
    assert heard(2, BlockAddResponse(bytes(32), True))[0].udp_data(PORT) == answered
