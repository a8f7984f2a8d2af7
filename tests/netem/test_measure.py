"""Test measurements of the network: the statistics, the comparisons, and how they detect wrong networks."""

from __future__ import annotations

import math
import signal
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from netem import estimates
from netem.conditions import NetworkConditions
from netem.engine import AppliedConditions, ReceiverFigures
from netem.estimates import Estimate, MachineLateness, ReceivedStream
from netem.lab import EngineName, Lab
from netem.link import Delay, GilbertElliott, LinkConditions
from netem.measure import EngineMeasurement, MeasuredQuantity, NetworkStudy, measure, studies
from netem.observers import DisturbedError, PacketArrival, check, in_lab, in_medium
from tests.machine import require
from tests.netem.conftest import PORT, Air, play

NEVER_LATE = MachineLateness([0.0] * 10_000, [0.0] * 10)
SOME = 3000
Z = 3.2905267314919255  # of 99.9 %, two-sided


def received(
    arrivals: list[tuple[int, float]], sent_s: list[float], lateness: MachineLateness = NEVER_LATE
) -> ReceivedStream:
    return ReceivedStream(sent_s, sorted(arrivals, key=lambda arrival: arrival[1]), lateness)


# Statistics


def test_share_has_wilsons_interval() -> None:
    assert estimates.share(0, 10_000) == Estimate(0.0, 0.0, pytest.approx(Z**2 / (10_000 + Z**2)), 10_000)
    assert estimates.share(100, 100).high == 1.0
    half = estimates.share(50, 100)
    assert half.high - 0.5 == pytest.approx(Z / (2 * math.sqrt(100 + Z**2)))
    assert 0.5 - half.low == pytest.approx(half.high - 0.5)
    quarter_worth = estimates.share(200, 400, worth=0.25)
    assert (quarter_worth.low, quarter_worth.high) == pytest.approx((half.low, half.high))
    assert estimates.share(0, 0) == Estimate(0, 0, 0, 0)


def test_mean_and_deviation_have_normal_intervals() -> None:
    mean = estimates.mean([1.0, 2.0, 3.0, 4.0, 5.0])
    margin = Z * math.sqrt(2.5 / 5)
    assert (mean.measured, mean.low, mean.high) == pytest.approx((3, 3 - margin, 3 + margin))
    deviation = estimates.deviation([-1.0, 1.0] * 50)
    assert (deviation.measured, deviation.low, deviation.high) == pytest.approx((1, 1, 1))
    random = Random(1)
    normal = estimates.deviation([random.gauss(0, 2) for _ in range(20_000)])
    assert normal.low < 2 < normal.high
    assert normal.high - normal.low == pytest.approx(2 * Z * 2 / math.sqrt(2 * 20_000), rel=0.05)


def test_interval_of_burst_losses_accounts_for_correlation() -> None:
    bursts, count = GilbertElliott(0.05, 0.25), 2000
    random = Random(2)
    outside = {"chain": 0, "independent": 0, "length": 0}
    for _ in range(400):
        bad = False
        arrivals = []
        for number in range(count):
            if not bad:
                arrivals.append((number, float(number)))
            bad = random.random() >= bursts.r if bad else random.random() < bursts.p
        one = received(arrivals, [0.0] * count)
        for key, estimate, asked in (
            ("chain", estimates.lost_in_bursts(one), bursts.mean),
            ("independent", estimates.lost(one), bursts.mean),
            ("length", estimates.burst_length(one), 1 / bursts.r),
        ):
            outside[key] += not estimate.low <= asked <= estimate.high
    assert outside["chain"] <= 4
    assert outside["length"] <= 8  # 83 bursts are few for a normal interval
    assert outside["independent"] > 20


def test_unfinished_burst_is_not_counted() -> None:
    gone = {2, 3, 4, 7, 9, 10, 17, 18, 19}
    one = received([(number, 0.0) for number in range(20) if number not in gone], [0.0] * 20)
    assert estimates.burst_length(one).measured == 2.0  # 3, 1 and 2: the last one goes on


def test_delay_excludes_the_lateness_of_the_machine() -> None:
    way_s = [0.001, 0.004] * 50
    sent_s = [float(number) for number in range(100)]
    arrivals = [(number, sent_s[number] + 0.1 + way_s[number]) for number in range(100)]
    mean = estimates.delay_mean(received(arrivals, sent_s, MachineLateness(way_s, [0.002, 0.002])))
    assert (mean.measured, mean.high) == pytest.approx((0.1, 0.1))
    assert mean.low == pytest.approx(0.098)  # possible lateness of timers
    deviation = estimates.delay_deviation(received(arrivals, sent_s, MachineLateness(way_s, [0.0, 0.0])))
    assert (deviation.low, deviation.high) == pytest.approx((0, 0), abs=1e-9)
    jittered = [(number, sent_s[number] + (0.09, 0.11)[number % 2]) for number in range(100)]
    deviation = estimates.delay_deviation(received(jittered, sent_s, MachineLateness([0.0] * 100, [0.0, 0.004])))
    assert (deviation.measured, deviation.high) == pytest.approx((0.01, 0.01))
    assert deviation.low == pytest.approx(math.sqrt(0.01**2 - 0.002**2))  # timers may have added their delay


def test_rate_is_measured_in_the_longest_queue() -> None:
    # Five that queue for 10 ms each; a pause; and two more.
    sent_s = [0.0, 0.001, 0.002, 0.003, 0.004, 1.0, 1.001]
    at_s = [0.01, 0.02, 0.03, 0.04, 0.05, 1.01, 1.02]
    found = estimates.rate(received(list(enumerate(at_s)), sent_s), packet_bits=1000)
    assert (found.measured, found.packets) == (pytest.approx(100_000), 5)
    late = MachineLateness([0.0, 0.003], [0.001])
    found = estimates.rate(received(list(enumerate(at_s)), sent_s, late), packet_bits=1000)
    assert (found.low, found.high) == pytest.approx((4000 / 0.044, 4000 / 0.036))


def test_queue_limit_is_the_number_of_waiting_packets_at_a_loss() -> None:
    sent_s = [number * 0.01 for number in range(100)]
    received_packets: list[tuple[int, float]] = []
    for number, now in enumerate(sent_s):  # each waits 95 ms, and three packets may wait
        if sum(at > now for _, at in received_packets) < 3:
            received_packets.append((number, now + 0.095))
    found = estimates.waiting_when_lost(received(received_packets, sent_s), delay_s=0.095)
    assert (found.low, found.measured, found.high) == (3, 3, 3)
    late = [(number, at + 0.01) for number, at in received_packets]  # sometimes a fourth packet seems to wait
    found = estimates.waiting_when_lost(received(late, sent_s), delay_s=0.095)
    assert found.low <= 3 <= found.high
    rarely = [(number, at + 0.01 * (number < 9)) for number, at in received_packets]
    found = estimates.waiting_when_lost(received(rarely, sent_s), delay_s=0.095)
    assert (found.low, found.high) == (3, 3)


# Questions and answers


def one_question(asked: float) -> NetworkStudy:
    question = MeasuredQuantity(1, 4, "loss", "lost", asked, estimates.lost)
    return NetworkStudy(NetworkConditions(LinkConditions(asked), {3: LinkConditions()}), (question,))


def losing(*shares: float) -> tuple[list[tuple[NetworkStudy, int]], EngineMeasurement]:
    """Measure a network that loses the next of these shares of packets in each measurement. Return the requested
    measurements, and the result.
    """
    asked: list[tuple[NetworkStudy, int]] = []
    kept = iter(shares)

    def observe(study: NetworkStudy, packets: int) -> Mapping[tuple[int, int], ReceivedStream]:
        asked.append((study, packets))
        first = round(next(kept) * packets)
        stream = received([(number, 0.0) for number in range(first, packets)], [0.0] * packets)
        return {(1, receiver): stream for receiver in study.receivers}

    other = MeasuredQuantity(1, 5, "nothing", "lost", shares[0], estimates.lost)
    study = replace(one_question(0.15), questions=(*one_question(0.15).questions, other))
    return asked, measure("test", [study], observe, 1000)


def test_answer_outside_is_measured_again_and_both_are_kept() -> None:
    asked, measured = losing(0.3, 0.15)
    assert [[question.receiver for question in study.questions] for study, _ in asked] == [[4, 5], [4]]
    assert asked[1][0].conditions == asked[0][0].conditions
    row, other = measured.rows
    assert measured.ok
    assert row.before is not None
    assert (row.answer.measured, row.before.measured) == pytest.approx((0.15, 0.3))
    assert other.before is None
    as_json = row.to_json()
    assert (as_json["ok"], as_json["measured"], as_json["before"]["measured"]) == (True, 0.15, 0.3)


def test_answer_outside_twice_is_not_ok() -> None:
    asked, measured = losing(0.3, 0.3)
    assert len(asked) == 2
    assert [row.ok for row in measured.rows] == [False, True]
    assert not measured.ok


def test_all_answers_in_virtual_time_are_ok() -> None:
    measured = measure("medium", studies("medium"), in_medium(seed=5))
    assert [row for row in measured.rows if not row.ok] == []
    quantities = {row.question.condition.split()[0] for row in measured.rows}
    assert quantities == {"loss", "delay", "reorder", "corrupt", "rate", "limit", "duplicate", "partition"}
    assert {row.answer.packets for row in measured.rows} == {10_000}


WRONG = {
    "loss 0.15": LinkConditions(0.17),
    "loss in bursts, p 0.05, r 0.25": LinkConditions(GilbertElliott(0.05, 0.2)),
    "delay 100 ms": LinkConditions(delay=Delay(0.101)),
    "delay 100 ± 20 ms uniform": LinkConditions(delay=Delay(0.1, 0.021)),
    "delay 100 ± 20 ms normal": LinkConditions(delay=Delay(0.1, 0.02, "pareto")),
    "delay 100 ± 20 ms pareto": LinkConditions(delay=Delay(0.1, 0.023, "pareto")),
    "delay 100 ± 20 ms paretonormal": LinkConditions(delay=Delay(0.1, 0.02, "normal")),
    "reorder 0.25, delay 100 ms": LinkConditions(delay=Delay(0.1), reorder=0.3),
    "corrupt 0.2": LinkConditions(corrupt=0.25),
    "rate 500 kbit/s": LinkConditions(rate=501_000),
    "limit 50, delay 100 ms": LinkConditions(delay=Delay(0.1), limit=51),
    "duplicate 0.3": LinkConditions(duplicate=0.35),
}


@pytest.mark.parametrize("condition", WRONG)
def test_wrong_conditions_are_found(condition: str) -> None:
    everything = [question for study in studies("medium") for question in study.questions]
    questions = tuple(replace(question, receiver=4) for question in everything if question.condition == condition)
    wrong = NetworkConditions(receivers={4: WRONG[condition]})
    assert not measure("medium", [NetworkStudy(wrong, questions)], in_medium(seed=6)).ok


# Real packets


@pytest.mark.lab
def test_answers_with_real_packets_are_ok(engine: EngineName) -> None:
    for _ in range(2):  # a machine that was busy for some time does not mean that the engine is wrong
        measured = measure(engine, studies(engine), in_lab(engine))
        if measured.ok:
            break
    assert [row.to_json() for row in measured.rows if not row.ok] == []
    # On a busy machine, packets are sent so slowly that few of them wait for the rate.
    assert all(row.answer.packets >= 5000 for row in measured.rows if row.question.quantity != "rate")


@pytest.mark.lab
def test_network_with_excessive_loss_is_found(engine: EngineName) -> None:
    study = replace(one_question(0.15), conditions=NetworkConditions(LinkConditions(0.2), {3: LinkConditions()}))
    (row,) = measure(engine, [study], in_lab(engine), SOME).rows
    assert not row.ok
    assert row.answer.measured == pytest.approx(0.2, abs=0.04)


@pytest.mark.lab
def test_network_with_excessive_delay_is_found(netem: EngineName) -> None:
    question = MeasuredQuantity(1, 4, "delay 100 ms", "mean", 0.1, estimates.delay_mean)
    study = NetworkStudy(NetworkConditions(receivers={4: LinkConditions(delay=Delay(0.11))}), (question,))
    (row,) = measure(netem, [study], in_lab(netem), SOME).rows
    assert not row.ok
    assert row.answer.measured == pytest.approx(0.11, abs=0.005)


@pytest.mark.lab
def test_receiver_reports_overflows_of_its_buffer(tmp_path: Path) -> None:
    require(None)
    count = 15_000

    async def story() -> None:
        async with await Lab.open([1, 2], log=tmp_path / "lab.log") as lab:
            air = Air(lab, tmp_path)
            listener = await air.start_ready(2, "receive", PORT)
            await listener.process.send_signal(signal.SIGSTOP)
            await air.run(1, "broadcast", PORT, count, 0, lab.broadcast, 12, 0)
            await listener.process.send_signal(signal.SIGCONT)
            found = await listener.finish()
            assert found["overflow"] > 0
            assert len(found["numbers"]) + found["overflow"] == count

    play(story())


def test_loss_by_the_machine_is_an_error_unless_corruption_hides_it() -> None:
    study = one_question(0.15)
    one, two = (AppliedConditions("test", {4: ReceiverFigures.of({}, (), passed, 0, 0)}) for passed in (1, 2))
    received_packets = {(1, 4): [PacketArrival(0, 0.0, 0.1)]}
    check(study, {4: {"overflow": 0}}, received_packets, one)
    with pytest.raises(DisturbedError, match="itself lost 1 of the packets to vehicle 4"):
        check(study, {4: {"overflow": 0}}, received_packets, two)
    with pytest.raises(DisturbedError, match="overflowed"):
        check(study, {4: {"overflow": 1}}, received_packets, one)
    corrupting = replace(study, conditions=NetworkConditions(LinkConditions(corrupt=0.2)))
    check(corrupting, {4: {"overflow": 0}}, received_packets, two)
