"""A secured agent handles what is authentic and fresh, and says why it drops the rest."""

from collections import Counter

import pytest

from tests.ucp.secure.swarm import KEYS, ROSTER, agent, completes_a_block, secrets_of
from ucp.block import Block
from ucp.messages import BlockAddRequest, BlockResponse, CommitBlock, RequestForBlock, encode
from ucp.secure._epochs import AHEAD
from ucp.secure.bundle import KeySet
from ucp.secure.envelope import CLEAR, MAX_DATAGRAM_BYTES, sealed_bytes
from ucp.secure.secured_agent import SecuredAgent
from ucp.secure.session import Session
from ucp.store import StoredState

EPOCH_S = KEYS.public.epoch_s


def vote_on(asker: SecuredAgent, *others: SecuredAgent, now: float = 0.0) -> list[bytes]:
    """What the others answer to the block that the first proposes."""
    (proposal,) = completes_a_block(asker, now)
    return [answer for other in others for answer in heard(other, proposal, now)]


def heard(receiver: SecuredAgent, datagram: bytes, now: float = 0.0) -> list[bytes]:
    receiver.receive_datagram(datagram, now)
    return receiver.datagrams_to_send()


def test_agents_with_keys_commit_a_block_and_keep_its_makers_signature() -> None:
    one, two, three = map(agent, ROSTER)
    for answer in vote_on(one, two, three):
        one.receive_datagram(answer, 1.0)
    one.handle_timer(10.0)
    (commit,) = one.datagrams_to_send()
    for other in (two, three):
        assert heard(other, commit, 10.0) == []
        assert other.state.chain.top_chain_hash == one.state.chain.top_chain_hash
        assert other.signatures == one.signatures
        assert other.dropped == Counter()
    assert len(one.signatures) == 1


def test_the_trace_says_what_was_said_in_plain() -> None:
    one, two = agent(1), agent(2)
    (proposal,) = completes_a_block(one)
    heard(two, proposal)
    heard(two, proposal)
    (sent,) = [sent for entry in one.trace() for sent in getattr(entry, "sent", ())]
    plain, dropped = two.trace()
    assert plain.input.text == sent.datagram.text  # type: ignore[union-attr]
    assert dropped.dropped == "replayed"  # type: ignore[union-attr]


def test_the_largest_datagram_has_room() -> None:
    block = Block(1, 1, bytes(1024))
    largest = sealed_bytes(CommitBlock(block, bytes(32)))
    assert largest == len(agent(1).session.seal(0, CommitBlock(block, bytes(32)), None, None, 0))
    assert largest == 1248 <= MAX_DATAGRAM_BYTES


def test_every_bit_counts() -> None:
    two = agent(2)
    (proposal,) = completes_a_block(agent(1))
    for position in range(len(proposal)):
        forged = bytearray(proposal)
        forged[position] ^= 1 << position % 8
        two.receive_datagram(bytes(forged), 0.0)
    assert two.received == Counter()
    assert two.dropped.total() == len(proposal)
    heard(two, proposal)
    assert two.received.total() == 1  # forgeries used up nothing of the window


def _as_another(proposal: bytes) -> bytes:
    return proposal[:4] + (3).to_bytes(4, "big") + proposal[8:]


def test_who_is_dropped_and_why() -> None:
    two = agent(2)
    (proposal,) = completes_a_block(agent(1))
    other_mission = agent(1, KeySet.derived(b"o" * 32, ROSTER))
    imposter = agent(3)
    imposter.session.agent_id = 1  # has the group's keys, and not those of 1
    for datagram, why in (
        (proposal[:2], "truncated"),
        (proposal[: CLEAR.size - 1], "truncated"),
        (proposal + bytes(MAX_DATAGRAM_BYTES), "oversized"),
        (b"XX" + proposal[2:], "wrong magic"),
        (encode(1, 0, BlockAddRequest(bytes(32), bytes(32))), "not secured"),
        (proposal[:2] + b"\3" + proposal[3:], "wrong version"),
        (proposal[:4] + bytes(4) + proposal[8:], "impossible sender"),
        (proposal[:-1], "wrong length"),
        (proposal[:3] + b"\x0b" + proposal[4:], "unknown type"),
        (proposal[:4] + (2).to_bytes(4, "big") + proposal[8:], "own sender"),
        (proposal[:4] + (9).to_bytes(4, "big") + proposal[8:], "sender not on the roster"),
        (proposal[:14] + (AHEAD + 1).to_bytes(4, "big") + proposal[18:], "epoch out of range"),
        (_as_another(proposal), "not authentic"),
        (completes_a_block(other_mission)[0], "not authentic"),
        (imposter.session.seal(0, BlockAddRequest(bytes(32), bytes(32)), None, None, 0), "not signed by its sender"),
        (proposal, None),
        (proposal, "replayed"),
    ):
        before = two.dropped.copy()
        two.receive_datagram(datagram, 0.0)
        assert two.dropped - before == Counter([why] if why else []), why


def test_a_vote_for_an_earlier_round_does_not_count() -> None:
    one, two, three = map(agent, ROSTER)
    answers = vote_on(one, two, three)
    one.handle_timer(10.0)  # nobody has answered in time
    one.datagrams_to_send()
    completes_a_block(one, 11.0)
    for answer in answers:
        one.receive_datagram(answer, 11.0)
    assert one.dropped == Counter({"answers no request": 2})


def test_a_block_that_its_maker_did_not_sign_is_dropped() -> None:
    two, three = agent(2), agent(3)
    forged = CommitBlock(Block(1, 5, b"never made"), bytes(32))
    signature = bytes(64)
    assert heard(two, three.session.seal(0, forged, None, signature, 0)) == []
    assert two.dropped == Counter({"block not signed by its maker": 1})
    assert two.signatures == {}


def test_a_block_of_nobody_is_dropped_before_its_signature_is_looked_at() -> None:
    two, three = agent(2), agent(3)
    heard(two, three.session.seal(0, CommitBlock(Block(77, 5, b"of whom?"), bytes(32)), None, None, 0))
    assert two.dropped == Counter({"block not of the roster": 1})


def test_a_body_that_no_message_has_is_dropped_though_it_is_authentic() -> None:
    two, liar = agent(2), agent(3)
    heard(two, liar.session.seal(0, RequestForBlock(b"short"), None, None, 0))
    heard(two, liar.session.seal(1, BlockResponse(Block(1, 5, b"x")), None, b"short", 0))
    assert two.dropped == Counter({"wrong length": 2})


def test_an_epoch_ends_for_all_and_its_secret_with_it() -> None:
    one, two = agent(1), agent(2)
    late = one.session.seal(0, RequestForBlock(bytes(32)), None, None, 0)
    two.session.epochs.look_at(EPOCH_S)
    assert heard(two, late, EPOCH_S) == []  # the epoch before is still good
    assert two.dropped == Counter()
    late = one.session.seal(1, RequestForBlock(bytes(32)), None, None, 0)
    heard(two, late, 2 * EPOCH_S)
    assert two.dropped == Counter({"epoch out of range": 1})


def test_who_hears_of_a_later_epoch_follows() -> None:
    one, two = agent(1), agent(2)
    one.session.epochs.look_at(AHEAD * EPOCH_S)
    heard(two, one.session.seal(0, RequestForBlock(bytes(32)), None, None, 0))
    assert two.session.epochs.current == AHEAD
    one.session.epochs.look_at((AHEAD + 1) * EPOCH_S)
    heard(two, one.session.seal(1, RequestForBlock(bytes(32)), None, None, 0))
    assert two.dropped == Counter({"epoch out of range": 1})


def test_the_newest_life_of_a_sender_counts() -> None:
    two, before, after = agent(2), agent(1, started_us=5), agent(1, started_us=6)
    old, new = (life.session.seal(0, RequestForBlock(bytes(32)), None, None, 0) for life in (before, after))
    heard(two, new)
    heard(two, old)
    assert two.dropped == Counter({"old boot": 1})
    assert old[CLEAR.size :] != new[CLEAR.size :]


def test_a_vehicle_that_comes_back_begins_a_later_life_whatever_its_clock_says() -> None:
    before, after = agent(1, started_us=5), agent(1, started_us=3)
    completes_a_block(before)
    recovered = StoredState.of(before.state)
    recovered.secured = before.secured_state()
    after.boot(recovered, 1.0)
    assert after.started_us == 6
    assert after.signatures == before.signatures
    assert completes_a_block(after, 1.0)[0][:3] == b"UC\2"


def test_no_secret_is_shown() -> None:
    one = agent(1)
    bundle = KEYS.bundle(1)
    shown = f"{bundle!r} {one.session!r} {one.session.epochs!r} {vars(one.session)!r} {KEYS!r}"
    for secret in secrets_of(bundle):
        assert secret.hex() not in shown
        assert repr(secret) not in shown


def test_a_life_ends_sending_when_its_sequence_numbers_are_used() -> None:
    one = agent(1)
    one._core._sequence = 2**32
    assert completes_a_block(one) == []
    assert one.problem is not None


def test_a_session_is_of_one_agent() -> None:
    with pytest.raises(ValueError, match="agent 1"):
        SecuredAgent(Session(KEYS.bundle(1), bytes(16)), 2, ROSTER, b"test")
    with pytest.raises(ValueError, match=r"\[4\]"):
        SecuredAgent(Session(KEYS.bundle(1), bytes(16)), 1, (*ROSTER, 4), b"test")
