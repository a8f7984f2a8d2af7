"""Test joined packet captures: receivers, losses, answers and forged datagrams."""

from collections import Counter
from pathlib import Path
from random import Random

import pytest

from harness.archive.packets.block_names import BlockNames, run_directories
from harness.archive.packets.capture_files import Captures as Read
from harness.archive.packets.capture_files import capture_files, read_captures
from harness.archive.packets.exchanges import (
    LinkLosses,
    MessageFilter,
    RequestAnswers,
    RequestOutcome,
    block_arrivals,
    count_losses,
    exchanges_about,
)
from harness.archive.packets.transmissions import Transmission, join
from harness.errors import CaptureError
from harness.report.packets_text import TransmissionFormatter
from tests.harness.captures import INBOUND, OUTBOUND, Captures, CaptureScript, PcapNg, frame, pcap, wall_ns
from tests.harness.mission import write_exports
from tests.ucp.air import Air, uniform_latency
from ucp.block import Block
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    NextInSequenceResponse,
    RequestForBlock,
    encode,
)
from ucp.trigger import MessageTrigger

BLOCK, CHAIN = Block(1, 5, b"events"), bytes(range(32))
PROPOSAL = BlockAddRequest(BLOCK.block_hash, CHAIN)
APPROVE, DISAPPROVE = BlockAddResponse(BLOCK.block_hash, True), BlockAddResponse(BLOCK.block_hash, False)
QUERY = ChainContainQuery(CHAIN)


def read(*paths: Path) -> Read:
    return read_captures(capture_files(paths))


def transmissions_of(scene: CaptureScript, path: Path, *without: int) -> list[Transmission]:
    return join(read(scene.write(path / "run", *without)))


def received(one: Transmission) -> dict[int | str, tuple[float, int]]:
    return {reception.by: (pytest.approx(reception.at_s), reception.copies) for reception in one.received}


@pytest.fixture(scope="module")
def finished_flight() -> tuple[Air, Captures]:
    """Play five agents that lose 15 % of their messages, receive some twice, and reconcile."""
    rng = Random(3)
    once = uniform_latency(rng, loss=0.15)
    air = Air(range(1, 6), lambda *delivery: once(*delivery) * (1 + (rng.random() < 0.1)))
    captures = Captures(air)
    air.generate_events(3)
    air.run_until(600)
    air.stop_events()
    air.settle()
    return air, captures


@pytest.fixture(scope="module")
def run_dir(finished_flight: tuple[Air, Captures], tmp_path_factory: pytest.TempPathFactory) -> Path:
    air, captures = finished_flight
    run = captures.write(tmp_path_factory.mktemp("packets") / "run")
    write_exports(air, run / "agents")
    return run


def test_losses_are_exactly_those_of_the_medium(finished_flight: tuple[Air, Captures], run_dir: Path) -> None:
    _, truth = finished_flight
    found = join(read(run_dir))
    datagrams = {(int.from_bytes(data[4:8], "big"), int.from_bytes(data[8:12], "big")): data for data in truth.sent}
    assert {(datagrams[one.sender, one.sequence], name) for one in found for name in one.lost_by} == truth.lost()
    assert {(datagrams[one.sender, one.sequence], name) for one in found for name in one.reached} == truth.heard
    assert [one.at_s for one in found] == pytest.approx(sorted(truth.sent.values()))
    assert {one.origin for one in found} == {"captured"}
    pairs = Counter((int.from_bytes(data[4:8], "big"), name) for data, name in truth.lost())
    sent = Counter(int.from_bytes(data[4:8], "big") for data in truth.sent)
    assert count_losses(found) == [
        LinkLosses(sender, receiver, sent[sender], pairs[sender, receiver])
        for sender in sorted(sent)
        for receiver in sorted(sent)
        if sender != receiver
    ]


def test_each_response_matches_the_request_in_the_trace(finished_flight: tuple[Air, Captures], run_dir: Path) -> None:
    """Compare with the agents' traces, which name the message that triggered each answer."""
    air, _ = finished_flight
    found = join(read(run_dir))
    exchanges = RequestAnswers(found)
    matched = {
        (response.sender, response.sequence): (request.sender, request.sequence)
        for request in found
        for response in exchanges.responses(request)
    }
    traced = {
        (agent_id, sent.seq): (run.trigger.sender, run.trigger.sequence)
        for agent_id, runs in air.runs.items()
        for run in runs
        for sent in run.sent
        if isinstance(run.trigger, MessageTrigger) and "Response" in sent.message
    }
    assert len(traced) > 100
    assert matched == traced


def test_request_has_an_outcome_for_each_vehicle(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2, 3, 4, 5)
    scene.send(10, 1, PROPOSAL, {2: 0.01, 3: 0.01, 4: 0.01})
    scene.send(10.02, 2, APPROVE)
    scene.send(10.03, 3, DISAPPROVE, {2: 0.01})
    scene.finish(20)
    request, *responses = transmissions_of(scene, tmp_path)
    answers = RequestAnswers([request, *responses]).answers(request)
    assert [(answer.by, answer.outcome) for answer in answers] == [
        (2, "answered"),
        (3, "response lost"),
        (4, "no answer"),
        (5, "request lost"),
    ]
    assert [answer.response and answer.response.summary.answer for answer in answers] == [
        "approve",
        "disapprove",
        None,
        None,
    ]


def test_each_type_of_request_matches_its_response(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2)
    pairs = [
        (PROPOSAL, APPROVE),
        (QUERY, ChainContainResponse(CHAIN, False)),
        (ChainHashSuccessorQuery(CHAIN), NextInSequenceResponse(CHAIN, BLOCK.block_hash, 5)),
        (ChainHashSuccessorQuery(CHAIN), NextInSequenceResponse(CHAIN, None, 5)),
        (RequestForBlock(BLOCK.block_hash), BlockResponse(BLOCK)),
    ]
    for number, (request, response) in enumerate(pairs):
        scene.send(number, 1, request)
        scene.send(number + 0.02, 2, response)
    scene.finish(10)
    found = transmissions_of(scene, tmp_path)
    exchanges = RequestAnswers(found)
    assert [exchanges.responses(one) for one in found[::2]] == [[one] for one in found[1::2]]


def test_response_answers_the_last_received_request(tmp_path: Path) -> None:
    """Let agents 1 and 3 send equal requests. Agent 2 does not answer the first request, and receives only the second
    request of agent 3.
    """
    scene = CaptureScript(1, 2, 3)
    scene.send(1, 3, QUERY)
    scene.send(2, 1, QUERY, {3: 0.01})
    scene.send(3, 3, QUERY)
    scene.send(3.02, 2, ChainContainResponse(CHAIN, True))
    scene.finish(10)
    found = transmissions_of(scene, tmp_path)
    exchanges = RequestAnswers(found)
    assert [len(exchanges.responses(one)) for one in found] == [0, 0, 1, 0]
    assert [answer.outcome for answer in exchanges.answers(found[1])] == ["request lost", "no answer"]


def test_simultaneous_requests_are_answered_in_order(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2, 3)
    scene.send(1, 1, QUERY)
    scene.send(1.001, 3, QUERY, {2: 0.01})
    scene.send(1.02, 2, ChainContainResponse(CHAIN, True))
    scene.send(1.021, 2, ChainContainResponse(CHAIN, True))
    scene.finish(10)
    found = transmissions_of(scene, tmp_path)
    exchanges = RequestAnswers(found)
    assert [exchanges.responses(one) for one in found[:2]] == [[found[2]], [found[3]]]


def test_duplicated_request_is_answered_twice(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2)
    scene.send(0, 1, QUERY)
    scene.send(1, 1, QUERY, {2: [0.01, 0.5]})
    scene.send(1.02, 2, ChainContainResponse(CHAIN, True))
    scene.send(1.2, 1, QUERY)
    scene.send(1.22, 2, ChainContainResponse(CHAIN, True))
    scene.send(1.52, 2, ChainContainResponse(CHAIN, True))
    scene.finish(10)
    found = transmissions_of(scene, tmp_path)
    _, twice, first, again, second, third = found
    assert received(twice) == {2: (1.01, 2)}
    exchanges = RequestAnswers(found)
    assert [exchanges.responses(one) for one in (twice, again)] == [[first, third], [second]]


def test_uncaptured_agent_answers_the_last_request_of_another(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2, 3)
    scene.send(1, 1, QUERY)
    scene.send(2, 3, QUERY)
    scene.send(3, 3, ChainContainResponse(CHAIN, True))
    scene.finish(10)
    found = transmissions_of(scene, tmp_path, 3)
    assert [len(RequestAnswers(found).responses(one)) for one in found] == [1, 0, 0]


def test_answered_request_arrived_although_the_capture_lacks_it(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2)
    scene.send(1, 1, QUERY, {})
    scene.send(2, 2, ChainContainResponse(CHAIN, True))
    scene.finish(10)
    found = transmissions_of(scene, tmp_path)
    assert [(answer.by, answer.outcome) for answer in RequestAnswers(found).answers(found[0])] == [(2, "answered")]


def test_outcomes_are_listed_from_answers_to_losses() -> None:
    answers = [RequestOutcome(2, "request lost"), RequestOutcome(3, "no answer"), RequestOutcome(4, "request lost")]
    assert (
        TransmissionFormatter(BlockNames([], []), str.upper, {}).answers(answers)
        == "answers: no answer: 3; REQUEST LOST: 2 4"
    )


def test_overtaking_packets_are_listed_in_order_of_sending(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2)
    scene.send(2, 1, APPROVE, {2: 0.1})
    scene.send(1, 1, PROPOSAL, {2: 9.0})
    found = transmissions_of(scene, tmp_path)
    assert [(one.at_s, received(one)) for one in found] == [(1, {2: (10, 1)}), (2, {2: (2.1, 1)})]


def test_restarted_agent_may_send_the_same_bytes_again(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2, 3)
    scene.send(60, 1, QUERY, {3: 0.01})
    scene.sequences[1] = 0
    scene.send(5, 1, QUERY, {2: 0.01})
    scene.finish(100)
    found = transmissions_of(scene, tmp_path)
    assert [(one.at_s, one.sequence, one.reached, one.lost_by) for one in found] == [
        (5, 0, [2], (3,)),
        (60, 0, [3], (2,)),
    ]


def test_loss_is_inferred_without_the_capture_of_the_sender(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2, 3)
    scene.send(5, 1, QUERY, {2: 0.01})
    scene.send(6, 1, QUERY, {})
    scene.finish(10)
    (seen,) = transmissions_of(scene, tmp_path, 1)
    assert (seen.origin, seen.at_s, seen.reached, seen.lost_by) == ("inferred", pytest.approx(5.01), [2], (3,))


def test_vehicle_without_running_capture_loses_nothing(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2, 3)
    scene.files[3] = PcapNg()  # A capture from the field does not contain the time at which it began.
    scene.send(1, 1, QUERY, {})
    scene.record(3, 2, OUTBOUND, encode(3, 0, QUERY))
    scene.send(3, 1, QUERY, {})
    scene.finish(4, 2)
    scene.send(5, 1, QUERY, {})
    scene.finish(10, 1, 3)
    found = [one for one in transmissions_of(scene, tmp_path) if one.sender == 1]
    assert [(one.lost_by, one.absent) for one in found] == [((2,), (3,)), ((2, 3), ()), ((3,), (2,))]


def test_datagram_missing_in_the_capture_of_its_sender_is_forged(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2, 3)
    scene.send(1, 1, QUERY)
    forged = encode(1, 77, PROPOSAL)
    scene.record(2, 5, INBOUND, forged)
    scene.record(1, 5, INBOUND, encode(3, 77, ChainContainResponse(CHAIN, True)))
    scene.finish(10)
    rogue = PcapNg()
    rogue.packet(wall_ns(6), OUTBOUND, frame(1, encode(1, 78, PROPOSAL)))
    run = scene.write(tmp_path / "run")
    (run / "capture" / "rogue.pcapng").write_bytes(rogue.data)
    found = join(read(run))
    assert [(one.sequence, one.origin, one.seen_leaving) for one in found if one.sender == 1] == [
        (0, "captured", 1),
        (77, "forged", None),
        (78, "forged", "rogue"),
    ]
    assert RequestAnswers(found).responses(found[0]) == ()
    assert not any(pair.sender == 1 and pair.sent > 1 for pair in count_losses(found))


def test_incomplete_capture_proves_no_forgery(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2)
    scene.send(1, 1, QUERY)
    scene.record(2, 5, INBOUND, encode(1, 77, PROPOSAL))
    scene.files[1].statistics(wall_ns(10), dropped=1)
    captures = read(scene.write(tmp_path / "run"))
    assert [one.origin for one in join(captures)] == ["captured", "inferred"]
    assert captures.problems == [
        f"{tmp_path}/run/capture/1.pcapng: frames that the capture itself missed, and that look like losses: 1"
    ]


def test_field_captures_count_time_from_the_first_packet(tmp_path: Path) -> None:
    """A capture that is named after a vehicle contains the vehicle's own datagrams as outbound. Any other file counts
    as the capture of a separate observer.
    """
    query, answer = frame(1, encode(1, 0, QUERY)), frame(2, encode(2, 0, ChainContainResponse(CHAIN, True)))
    (tmp_path / "1.pcap").write_bytes(pcap([(1_000_000, query), (1_500_000, answer)]))
    (tmp_path / "2.pcap").write_bytes(pcap([(1_250_000, query), (1_250_000, answer)]))
    (tmp_path / "tower.pcap").write_bytes(pcap([(1_300_000, answer), (9_000_000, b"")]))
    captures = read(tmp_path)
    request, response = join(captures)
    assert not captures.clock.of_run
    assert (request.at_s, request.origin, received(request)) == (0.0, "captured", {2: (0.25, 1)})
    assert (response.at_s, received(response)) == (0.25, {1: (0.5, 1), "tower": (0.3, 1)})
    assert request.absent == ("tower",)
    assert RequestAnswers([request, response]).responses(request) == [response]


def test_capture_of_another_run_is_left_out(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2)
    scene.send(1, 1, QUERY)
    run = scene.write(tmp_path / "run")
    other = tmp_path / "2.pcapng"
    other.write_bytes((run / "capture" / "2.pcapng").read_bytes().replace(b'"speedup": 20.0', b'"speedup": 10.0'))
    captures = read(run / "capture" / "1.pcapng", other)
    assert captures.errors == [f"{other}: of another run than the captures before it; print each run separately"]
    assert [one.received for one in join(captures)] == [()]


def test_exchanges_about_a_block_include_all_its_messages(finished_flight: tuple[Air, Captures], run_dir: Path) -> None:
    air, _ = finished_flight
    found = join(read(run_dir))
    names = BlockNames(found, run_directories([run_dir]))
    block_hash = air.agents[3].state.completed[1]
    assert names.find("3.2") == names.find(block_hash.hex()[:10]) == block_hash
    exchanges = list(exchanges_about(block_hash, found, RequestAnswers(found)))
    numbers = [one.number for exchange in exchanges for one in (exchange.first, *exchange.answers)]
    assert len(numbers) == len(set(numbers))
    assert set(numbers) >= {one.number for one in found if one.summary.block_hash == block_hash}
    assert exchanges[0].first.summary.message == BlockAddRequest.NAME
    assert {answer.summary.message for answer in exchanges[0].answers} == {BlockAddResponse.NAME}
    carriers = [
        one
        for one in found
        if one.summary.block_hash == block_hash and one.summary.message in ("Commit Block", "Block Response")
    ]
    assert set(block_arrivals(exchanges)) == {name for one in carriers for name in one.reached}


def test_block_names_follow_proposals_without_exports(run_dir: Path) -> None:
    found = join(read(run_dir))
    with_exports, alone = BlockNames(found, run_directories([run_dir])), BlockNames(found, [])
    proposed = {one.summary.block_hash for one in found if one.summary.message == BlockAddRequest.NAME}
    assert len(proposed) > 5
    for block_hash in proposed:
        assert block_hash is not None
        assert alone.block(block_hash) == with_exports.block(block_hash)


def test_late_capture_gives_no_block_names(tmp_path: Path) -> None:
    scene = CaptureScript(1, 2)
    scene.sequences[1] = 40
    scene.send(1, 1, PROPOSAL)
    scene.send(2, 1, CommitBlock(BLOCK, CHAIN))
    names = BlockNames(transmissions_of(scene, tmp_path), [])
    digits = BLOCK.block_hash.hex()[:8]
    assert names.block(BLOCK.block_hash) == digits
    assert names.chain(CHAIN) == f"{CHAIN.hex()[:8]} ({digits})"
    with pytest.raises(CaptureError, match=r"--follow 1\.1: no known message is about that block"):
        names.find("1.1")


def test_selection_filters_by_sender_receiver_message_and_time(run_dir: Path) -> None:
    captures = read(run_dir)
    found = join(captures)
    selection = MessageFilter(sender=2, receiver=3, message="commit block", between_s=(100, 500))
    selected = list(selection.filter(found, captures))
    whole = [
        one for one in found if one.sender == 2 and one.summary.message == "Commit Block" and 100 <= one.at_s <= 500
    ]
    assert [one.number for one in selected] == [one.number for one in whole]
    assert selected
    assert [one.lost_by for one in selected] == [(3,) if 3 in one.lost_by else () for one in whole]
    assert all(one.reached in ([], [3]) for one in selected)
    with pytest.raises(CaptureError, match="no such message; use one of Block Add Request, "):
        MessageFilter(message="Hello")
    with pytest.raises(CaptureError, match="the first second is not before the last"):
        MessageFilter(between_s=(2, 1))
    with pytest.raises(CaptureError, match="no capture of that vehicle; captures are of 1, 2, 3, 4, 5"):
        list(MessageFilter(receiver=9).filter(found, captures))
