"""Test the budgets that protect an agent.

They limit the keys that an attacker without keys can make the agent derive, and the signatures that an attacker with
keys can make it verify.
"""

from dataclasses import replace
from random import Random

import pytest

from tests.ucp.secure.swarm import KEYS, ROSTER, session
from ucp.block import Block
from ucp.messages import CommitBlock, RequestForBlock
from ucp.secure.crypto_suite import SenderKeys, UnverifiedSignature, verify
from ucp.secure.envelope import CLEAR, REVOCATION, ClearHeader
from ucp.secure.sealed_datagrams import CRYPTO_FUNCTIONS
from ucp.secure.secured_agent import SecuredAgent, make_boot
from ucp.secure.session import UNKNOWN_BOOTS_AT_ONCE, Session
from ucp.secure.session import WRONG_SIGNATURES_AT_ONCE as BURST

QUERY = RequestForBlock(bytes(32))
BOOT = make_boot(1, bytes(8))


class CountingAgent(SecuredAgent):
    """Agent 1. The class counts the signatures that the agent verifies, and the keys of other agents that it
    derives.
    """

    def __init__(self) -> None:
        self.verified = self.derived = 0
        crypto = replace(CRYPTO_FUNCTIONS, verify=self._verify, sender_keys=self._derive)
        super().__init__(Session(KEYS.bundle(1), BOOT, crypto=crypto), 1, ROSTER, b"test")

    def _verify(self, claim: UnverifiedSignature) -> bool:
        self.verified += 1
        return verify(claim)

    def _derive(self, secret: bytes, mission: bytes, epoch: int, sender: int, boot: bytes) -> SenderKeys:
        self.derived += sender != self.agent_id
        return SenderKeys(secret, mission, epoch, sender, boot)

    @property
    def epoch(self) -> int:
        """The number of the agent's current epoch."""
        return self.session.epochs.bundle.epoch

    def hears(self, datagram: bytes, now: float = 0.0) -> bool:
        before = self.received.total()
        self.receive_datagram(datagram, now)
        return self.received.total() > before


@pytest.fixture
def one() -> CountingAgent:
    return CountingAgent()


def test_outsider_cannot_make_an_agent_verify_a_signature(one: CountingAgent) -> None:
    rng, missed = Random(1), session(2).seal(5, QUERY, None, None, 0)
    forged = [missed[:at] + bytes([missed[at] ^ 1]) + missed[at + 1 :] for at in range(CLEAR.size, len(missed))]
    forged += [missed[: CLEAR.size - 18] + make_boot(2, rng.randbytes(8)) + missed[CLEAR.size - 2 :] for _ in range(9)]
    for number in range(50):
        body = number.to_bytes(2, "big") + b"\0\1\0\0\0\2" + rng.randbytes(64 + 16)
        forged.append(ClearHeader(REVOCATION, 2, number, 0, BOOT, 1).pack(len(body)) + body)
    for datagram in forged:
        assert not one.hears(datagram)
    assert one.verified == 0
    assert one.dropped == {"not authentic": len(forged)}
    assert one.hears(missed)
    assert one.verified == 1


def test_wrong_signatures_of_an_insider_exhaust_the_budget_of_one_sender(one: CountingAgent) -> None:
    insider = session(3)
    insider.agent_id = 2
    for sequence in range(10 * BURST):
        assert not one.hears(insider.seal(sequence, QUERY, None, None, 0))
    assert one.verified == BURST
    assert one.dropped["too many wrong signatures"] == 9 * BURST
    assert one.hears(session(3).seal(0, QUERY, None, None, 0))
    genuine = session(2).seal(0, QUERY, None, None, 0)
    assert not one.hears(genuine)
    assert one.hears(genuine, 1.0), "the budget returns"


def test_forged_blocks_of_an_insider_exhaust_its_budget(one: CountingAgent) -> None:
    insider, forged = session(3), CommitBlock(Block(2, 5, b"never made"), bytes(32))
    for sequence in range(10 * BURST):
        assert not one.hears(insider.seal(sequence, forged, None, bytes(64), 0))
    assert one.verified == 2 * BURST


def test_forged_revocations_of_an_insider_exhaust_their_budget(one: CountingAgent) -> None:
    insider = session(3)
    for number in range(10 * BURST):
        body = number.to_bytes(2, "big") + b"\0\1\0\0\0\2" + bytes(64)
        assert not one.hears(insider.seal_revocation(body, 0))
    assert one.dropped == {"not signed by the authority": BURST, "too many wrong signatures": 9 * BURST}
    assert one.hears(insider.seal(0, QUERY, None, None, 0))


def of_boot(datagram: bytes, boot: bytes) -> bytes:
    return datagram[: CLEAR.size - 18] + boot + datagram[CLEAR.size - 2 :]


def test_unknown_boots_exhaust_a_budget_that_known_senders_do_not_need(one: CountingAgent) -> None:
    two = session(2)
    assert one.hears(two.seal(0, QUERY, None, None, 0))
    forged, rng = session(3).seal(9, QUERY, None, None, 0), Random(1)
    count = 3 * UNKNOWN_BOOTS_AT_ONCE
    for _ in range(count):
        assert not one.hears(of_boot(forged, make_boot(2, rng.randbytes(8))))
    assert one.derived == UNKNOWN_BOOTS_AT_ONCE
    assert one.dropped["too many unknown boots"] == count - one.dropped["not authentic"] > 0
    assert one.hears(two.seal(1, QUERY, None, None, 0)), "the keys of this boot are known"
    three = session(3).seal(0, QUERY, None, None, 0)
    assert not one.hears(three)
    assert one.hears(three, 1.0), "the budget returns"


def test_forgeries_with_a_known_boot_derive_keys_once_per_epoch(one: CountingAgent) -> None:
    two = session(2)
    assert one.hears(two.seal(0, QUERY, None, None, 0))
    good = two.seal(1, QUERY, None, None, 0)
    for sequence in range(100):
        forged = good[:8] + (1000 + sequence).to_bytes(4, "big") + good[12:17] + bytes([sequence % 2]) + good[18:]
        assert not one.hears(forged)
    assert one.dropped == {"not authentic": 100}
    assert one.derived == 2


def test_flood_of_unknown_boots_does_not_mute_known_senders_in_a_new_epoch(one: CountingAgent) -> None:
    two, rng = session(2), Random(1)
    assert one.hears(two.seal(0, QUERY, None, None, 0))
    forged = session(3).seal(9, QUERY, None, None, 0)
    for _ in range(2 * UNKNOWN_BOOTS_AT_ONCE):
        one.hears(of_boot(forged, make_boot(2, rng.randbytes(8))))
    two.set_clock(KEYS.public.epoch_s)
    assert one.hears(two.seal(1, QUERY, None, None, 0)), "the own clock has not reached the new epoch"
    assert one.epoch == 0


def test_forged_revocations_of_unknown_boots_exhaust_the_same_budget(one: CountingAgent) -> None:
    for number in range(2 * UNKNOWN_BOOTS_AT_ONCE):
        body = bytes(100)
        header = ClearHeader(REVOCATION, 2, 0, 0, make_boot(number, bytes(8)), 1)
        assert not one.hears(header.pack(len(body)) + body)
    assert one.derived == UNKNOWN_BOOTS_AT_ONCE


def test_restarted_vehicle_is_heard_during_a_flood_of_unknown_boots(one: CountingAgent) -> None:
    assert one.hears(session(2).seal(0, QUERY, None, None, 0))
    restarted, rng, forged = session(2, started_us=5), Random(1), session(3).seal(9, QUERY, None, None, 0)
    per_s, sent_each = 40_000, 100
    heard = []
    for number in range(per_s):
        now = number / per_s
        one.hears(of_boot(forged, make_boot(2, rng.randbytes(8))), now)
        if number % sent_each == 0:
            heard.append(one.hears(restarted.seal(number, QUERY, None, None, 0), now))
    assert True in heard
    assert all(heard[heard.index(True) :]), "its keys are known from its first authentic datagram on"
