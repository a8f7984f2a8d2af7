"""Test an agent with keys: it accepts new authentic datagrams, and records why it drops other datagrams."""

from collections import Counter

import pytest

from tests.ucp.secure.swarm import KEYS, ROSTER, agent, complete_a_block, secrets_of
from ucp.block import Block
from ucp.messages import BlockAddRequest, BlockResponse, CommitBlock, RequestForBlock, encode
from ucp.secure._epochs import MAX_EPOCHS_AHEAD
from ucp.secure.bundle import KeySet
from ucp.secure.envelope import CLEAR, MAX_DATAGRAM_BYTES, sealed_bytes
from ucp.secure.secured_agent import SecuredAgent
from ucp.secure.session import Session
from ucp.store import StoredState

EPOCH_S = KEYS.public.epoch_s


def vote_on(proposer: SecuredAgent, *others: SecuredAgent, now: float = 0.0) -> list[bytes]:
    """Return the votes of the other agents on a block that the first agent has proposed."""
    (proposal,) = complete_a_block(proposer, now)
    return [answer for other in others for answer in receive(other, proposal, now)]


def receive(receiver: SecuredAgent, datagram: bytes, now: float = 0.0) -> list[bytes]:
    receiver.receive_datagram(datagram, now)
    return receiver.datagrams_to_send()


def test_secured_agents_commit_a_block_and_keep_its_signature() -> None:
    one, two, three = map(agent, ROSTER)
    for answer in vote_on(one, two, three):
        one.receive_datagram(answer, 1.0)
    one.handle_timer(10.0)
    (commit,) = one.datagrams_to_send()
    for other in (two, three):
        assert receive(other, commit, 10.0) == []
        assert other.state.chain.top_chain_hash == one.state.chain.top_chain_hash
        assert other.signatures == one.signatures
        assert other.dropped == Counter()
    assert len(one.signatures) == 1


def test_trace_contains_datagrams_in_plain_form() -> None:
    one, two = agent(1), agent(2)
    (proposal,) = complete_a_block(one)
    receive(two, proposal)
    receive(two, proposal)
    (sent,) = [sent for entry in one.trace() for sent in getattr(entry, "sent", ())]
    plain, dropped = two.trace()
    assert plain.input.text == sent.datagram.text  # type: ignore[union-attr]
    assert dropped.dropped == "replayed"  # type: ignore[union-attr]


def test_largest_secured_datagram_fits_the_limit() -> None:
    block = Block(1, 1, bytes(1024))
    largest = sealed_bytes(CommitBlock(block, bytes(32)))
    assert largest == len(agent(1).session.seal(0, CommitBlock(block, bytes(32)), None, None, 0))
    assert largest == 1248 <= MAX_DATAGRAM_BYTES


def test_datagram_with_a_flipped_bit_is_dropped() -> None:
    two = agent(2)
    (proposal,) = complete_a_block(agent(1))
    for position in range(len(proposal)):
        forged = bytearray(proposal)
        forged[position] ^= 1 << position % 8
        two.receive_datagram(bytes(forged), 0.0)
    assert two.received == Counter()
    assert two.dropped.total() == len(proposal)
    receive(two, proposal)
    assert two.received.total() == 1  # forgeries did not move the replay window


def _with_sender_3(proposal: bytes) -> bytes:
    return proposal[:4] + (3).to_bytes(4, "big") + proposal[8:]


def test_each_invalid_datagram_is_dropped_with_its_reason() -> None:
    two = agent(2)
    (proposal,) = complete_a_block(agent(1))
    other_mission = agent(1, KeySet.derived(b"o" * 32, ROSTER))
    imposter = agent(3)
    imposter.session.agent_id = 1  # it has the group secret, but not the private key of agent 1
    for datagram, reason in (
        (proposal[:2], "truncated"),
        (proposal[: CLEAR.size - 1], "truncated"),
        (proposal + bytes(MAX_DATAGRAM_BYTES), "oversized"),
        (b"XX" + proposal[2:], "wrong magic"),
        (encode(1, 0, BlockAddRequest(bytes(32), bytes(32))), "not secured"),
        (proposal[:2] + b"\2" + proposal[3:], "wrong version"),
        (proposal[:4] + bytes(4) + proposal[8:], "impossible sender"),
        (proposal[:-1], "wrong length"),
        (proposal[:3] + b"\x0d" + proposal[4:], "unknown type"),
        (proposal[:4] + (2).to_bytes(4, "big") + proposal[8:], "own sender"),
        (proposal[:4] + (9).to_bytes(4, "big") + proposal[8:], "sender not on the roster"),
        (proposal[:14] + (MAX_EPOCHS_AHEAD + 1).to_bytes(4, "big") + proposal[18:], "epoch out of range"),
        (_with_sender_3(proposal), "not authentic"),
        (complete_a_block(other_mission)[0], "not authentic"),
        (imposter.session.seal(0, BlockAddRequest(bytes(32), bytes(32)), None, None, 0), "not signed by its sender"),
        (proposal, None),
        (proposal, "replayed"),
    ):
        before = two.dropped.copy()
        two.receive_datagram(datagram, 0.0)
        assert two.dropped - before == Counter([reason] if reason else []), reason


def test_vote_of_an_earlier_round_does_not_count() -> None:
    one, two, three = map(agent, ROSTER)
    answers = vote_on(one, two, three)
    one.handle_timer(10.0)  # no answer arrived in time
    one.datagrams_to_send()
    complete_a_block(one, 11.0)
    for answer in answers:
        one.receive_datagram(answer, 11.0)
    assert one.dropped == Counter({"answers no request": 2})


def test_block_without_its_makers_signature_is_dropped() -> None:
    two, three = agent(2), agent(3)
    forged = CommitBlock(Block(1, 5, b"never made"), bytes(32))
    signature = bytes(64)
    assert receive(two, three.session.seal(0, forged, None, signature, 0)) == []
    assert two.dropped == Counter({"block not signed by its maker": 1})
    assert two.signatures == {}


def test_block_of_an_unknown_agent_is_dropped_before_its_signature() -> None:
    two, three = agent(2), agent(3)
    receive(two, three.session.seal(0, CommitBlock(Block(77, 5, b"of whom?"), bytes(32)), None, None, 0))
    assert two.dropped == Counter({"block not of the roster": 1})


def test_authentic_datagram_with_a_malformed_body_is_dropped() -> None:
    two, liar = agent(2), agent(3)
    receive(two, liar.session.seal(0, RequestForBlock(b"short"), None, None, 0))
    receive(two, liar.session.seal(1, BlockResponse(Block(1, 5, b"x")), None, b"short", 0))
    assert two.dropped == Counter({"wrong length": 2})


def test_datagram_of_an_epoch_before_the_previous_one_is_dropped() -> None:
    one, two = agent(1), agent(2)
    late = one.session.seal(0, RequestForBlock(bytes(32)), None, None, 0)
    two.session.set_clock(0.0)
    assert receive(two, late, EPOCH_S) == []  # the previous epoch is still accepted
    assert two.dropped == Counter()
    late = one.session.seal(1, RequestForBlock(bytes(32)), None, None, 0)
    receive(two, late, 2 * EPOCH_S)
    assert two.dropped == Counter({"epoch out of range": 1})


def test_datagram_of_an_earlier_boot_is_dropped() -> None:
    two, before, after = agent(2), agent(1, started_us=5), agent(1, started_us=6)
    old, new = (each.session.seal(0, RequestForBlock(bytes(32)), None, None, 0) for each in (before, after))
    receive(two, new)
    receive(two, old)
    assert two.dropped == Counter({"old boot": 1})
    assert old[CLEAR.size :] != new[CLEAR.size :]


def test_rebooted_agent_gets_a_later_boot_although_its_clock_went_back() -> None:
    before, after = agent(1, started_us=5), agent(1, started_us=3)
    complete_a_block(before)
    recovered = StoredState.of(before.state)
    recovered.secured = before.secured_state()
    after.boot(recovered, 1.0)
    assert after.started_us == 6
    assert after.signatures == before.signatures
    assert complete_a_block(after, 1.0)[0][:3] == b"UC\3"


def test_repr_of_a_secured_agent_contains_no_secret() -> None:
    one = agent(1)
    bundle = KEYS.bundle(1)
    shown = f"{bundle!r} {one.session!r} {one.session.epochs!r} {vars(one.session)!r} {KEYS!r}"
    for secret in secrets_of(bundle):
        assert secret.hex() not in shown
        assert repr(secret) not in shown


def test_agent_without_unused_sequence_numbers_stops_sending() -> None:
    one = agent(1)
    one._core._sequence = 2**32
    assert complete_a_block(one) == []
    assert one.problem is not None


def test_agent_with_the_session_of_another_agent_is_rejected() -> None:
    with pytest.raises(ValueError, match="agent 1"):
        SecuredAgent(Session(KEYS.bundle(1), bytes(16)), 2, ROSTER, b"test")
    with pytest.raises(ValueError, match=r"\[4\]"):
        SecuredAgent(Session(KEYS.bundle(1), bytes(16)), 1, (*ROSTER, 4), b"test")
