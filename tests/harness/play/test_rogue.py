"""Test the rogue node (a sender of forged messages) without other agents."""

from random import Random
from typing import Any

import pytest

from harness.play.rogue import _journal
from harness.play.rogue._crafted import corrupted, random_message
from harness.play.rogue._rogue import RogueDatagram, RogueLogic
from harness.play.rogue.rogue_line import forged_sequence, injection_of
from harness.scenario.injection import MAX_FLOOD, MODELS
from ucp.block import Block, next_chain_hash
from ucp.messages import (
    TYPE_CODES,
    BlockAddRequest,
    BlockAddResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
    decode,
    encode,
)

ROSTER = (1, 2, 3)
TOP = bytes(range(32))
BLOCK = Block(1, 5_000_000, b"0123456789a")
COMMIT = encode(1, 7, CommitBlock(BLOCK, TOP))
REQUEST = encode(3, 8, BlockAddRequest(BLOCK.block_hash, TOP))


def rogue() -> RogueLogic:
    return RogueLogic(ROSTER, seed=1)


def begin(one: RogueLogic, what: str, now: float = 100.0, number: int = 1, **keys: Any) -> list[RogueDatagram]:
    one.begin(number, MODELS[what].model_validate(keys), now)
    return one.to_send()


def receive(one: RogueLogic, datagram: bytes, now: float) -> list[RogueDatagram]:
    one.receive(datagram, now)
    return one.to_send()


def wait(one: RogueLogic, until: float) -> list[tuple[float, RogueDatagram]]:
    """Return the datagrams that the rogue node sends until this time, each with the time at which it is sent."""
    sent = []
    while (at := one.next_timer()) is not None and at <= until:
        one.handle_timer(at)
        sent += [(at, injected) for injected in one.to_send()]
    return sent


def said(injected: RogueDatagram) -> Message:
    return decode(injected.datagram)[2]


def test_replay_sends_the_last_matching_datagrams_in_order() -> None:
    one = rogue()
    commits = [
        encode(sender, sequence, CommitBlock(BLOCK, TOP)) for sender, sequence in ((1, 1), (2, 1), (1, 2), (1, 3))
    ]
    for datagram in [*commits, REQUEST]:
        assert receive(one, datagram, 1.0) == []
    again = begin(one, "replay", message="Commit Block", sender=1, count=2)
    assert [(it.source, it.datagram) for it in again] == [(1, commits[2]), (1, commits[3])]
    assert [it.datagram for it in begin(one, "replay")] == [REQUEST]
    assert one.next_timer() is None


def test_replay_without_received_datagrams_sends_nothing() -> None:
    one = rogue()
    receive(one, b"no message", 1.0)
    assert begin(one, "replay", number=1) == []
    assert begin(one, "forge", number=2, message="Commit Block", sender=2) == []
    assert one.sent == {1: 0, 2: 0}


def test_duplicate_sends_copies_until_its_end() -> None:
    one = rogue()
    begin(one, "duplicate", for_s=10, copies=2, message="Commit Block")
    assert [it.datagram for it in receive(one, COMMIT, 109.9)] == [COMMIT, COMMIT]
    assert receive(one, REQUEST, 109.9) == []
    assert receive(one, COMMIT, 110.0) == []


def test_delayed_copy_is_sent_after_its_delay() -> None:
    one = rogue()
    begin(one, "delay", for_s=10, by_s=30, sender=3)
    assert receive(one, REQUEST, 101.0) == receive(one, REQUEST, 109.0) == receive(one, COMMIT, 109.0) == []
    receive(one, REQUEST, 110.0)
    assert [(at, it.datagram) for at, it in wait(one, 1000)] == [(131.0, REQUEST), (139.0, REQUEST)]


def test_corrupt_flips_the_requested_number_of_bits() -> None:
    one = rogue()
    begin(one, "corrupt", for_s=10, bits=3)
    (changed,) = receive(one, COMMIT, 101.0)
    assert changed.source == 1
    assert sum((a ^ b).bit_count() for a, b in zip(changed.datagram, COMMIT, strict=True)) == 3
    assert corrupted(b"\x0f", 1000, Random(1)) == b"\xf0"


def test_forged_commit_extends_the_last_received_chain() -> None:
    one = rogue()
    receive(one, COMMIT, 1.0)
    other = bytes(32)
    receive(one, encode(3, 9, BlockAddRequest(BLOCK.block_hash, other)), 2.0)
    (first,) = begin(one, "forge", number=4, message="Commit Block", sender=2)
    sender, sequence, commit = decode(first.datagram)
    assert isinstance(commit, CommitBlock)
    assert (first.source, sender, commit.block.agent_id, commit.block.timestamp_us) == (2, 2, 2, 100_000_000)
    assert commit.chain_hash == next_chain_hash(other, commit.block.block_hash)
    assert injection_of(sequence) == 4
    (second,) = begin(one, "forge", 101.0, number=5, message="Commit Block", sender=3)
    on_top = said(second)
    assert isinstance(on_top, CommitBlock)
    assert on_top.chain_hash == next_chain_hash(commit.chain_hash, on_top.block.block_hash)


@pytest.mark.parametrize(
    ("keys", "question", "answer"),
    [
        ({}, BlockAddRequest(TOP, TOP), BlockAddResponse(TOP, False)),
        ({"approve": True}, BlockAddRequest(TOP, TOP), BlockAddResponse(TOP, True)),
        ({"approve": True}, ChainContainQuery(TOP), ChainContainResponse(TOP, True)),
        ({}, ChainHashSuccessorQuery(TOP), NextInSequenceResponse(TOP, None, 0)),
    ],
)
def test_forge_answers_each_query_in_an_agents_name(keys: dict[str, Any], question: Message, answer: Message) -> None:
    one = rogue()
    begin(one, "forge", message=answer.NAME, sender=2, for_s=10, **keys)
    assert [(it.source, said(it)) for it in receive(one, encode(1, 1, question), 101.0)] == [(2, answer)]
    assert receive(one, encode(2, 1, question), 101.0) == []
    assert receive(one, encode(1, 2, RequestForBlock(TOP)), 101.0) == []
    assert receive(one, encode(1, 3, question), 110.0) == []


def test_forged_vote_names_the_chain_if_votes_do() -> None:
    one = rogue()
    begin(one, "forge", message="Block Add Response", sender=2, for_s=10)
    receive(one, encode(1, 1, BlockAddResponse(TOP, True, TOP)), 101.0)
    (vote,) = receive(one, REQUEST, 101.0)
    assert said(vote) == BlockAddResponse(BLOCK.block_hash, False, TOP)


def test_flood_is_well_formed_evenly_spaced_and_reproducible() -> None:
    sent = []
    for _ in range(2):
        one = rogue()
        first = begin(one, "flood", for_s=10, per_s=20)
        sent.append([(100.0, it) for it in first] + wait(one, 1000))
    assert sent[0] == sent[1]
    assert len(sent[0]) == 200
    assert [at for at, _ in sent[0]] == pytest.approx([100 + count / 20 for count in range(200)])
    decoded = [decode(it.datagram) for _, it in sent[0]]
    assert {sender for sender, _, _ in decoded} == set(ROSTER)
    assert {type(message) for _, _, message in decoded} == set(TYPE_CODES)
    assert len({sequence for _, sequence, _ in decoded}) == 200


def test_slow_machine_shortens_the_flood_in_number_not_in_time() -> None:
    one = rogue()
    begin(one, "flood", for_s=10, per_s=1000)
    one.handle_timer(109.0)
    assert 0 < len(one.to_send()) < 9000
    one.handle_timer(110.0)
    assert (one.to_send(), one.next_timer()) == ([], None)


@pytest.mark.parametrize("message", TYPE_CODES)
def test_random_messages_of_every_type_are_well_formed(message: type[Message]) -> None:
    for seed in range(50):
        layer = random_message(message.NAME, ROSTER, 5, Random(seed))
        assert type(decode(bytes(encode(1, 1, message.from_body(bytes(layer)))))[2]) is message


def test_sequence_numbers_identify_the_injection() -> None:
    assert injection_of(2**31 - 1) is None
    for number in (1, 2, 10_000):
        for count in (0, 1, MAX_FLOOD - 1):
            assert injection_of(forged_sequence(number, count)) == number
    assert forged_sequence(10_000, MAX_FLOOD) < 2**32


def test_journal_has_a_line_for_each_datagram_and_counts_a_flood(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_journal, "LINES", 2)
    lines: list[dict[str, Any]] = []
    book = _journal.RogueJournal(lines.append)
    for at_s, datagram in ((1.0, COMMIT), (1.1, COMMIT[:-1]), (2.1, COMMIT), (2.9, COMMIT[:5]), (3.0, COMMIT)):
        book.add(RogueDatagram(1, "replay", 1, datagram), at_s)
    book.close()
    assert [line.get("message", line.get("refused")) for line in lines[:2]] == ["Commit Block", "wrong length"]
    assert lines[0]["block"] == BLOCK.block_hash.hex()
    assert [(line["at_s"], line["count"], line["messages"], line["refused"]) for line in lines[2:]] == [
        (2, 2, {"Commit Block": 1}, {"truncated": 1}),
        (3, 1, {"Commit Block": 1}, {}),
    ]
