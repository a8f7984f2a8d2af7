"""An outsider cannot make an agent verify a signature. An insider can only until a budget is empty."""

from dataclasses import replace
from random import Random

import pytest

from tests.ucp.secure.swarm import KEYS, ROSTER, session
from ucp.block import Block
from ucp.messages import CommitBlock, RequestForBlock
from ucp.secure._budget import BURST
from ucp.secure.crypto_suite import UnverifiedSignature, verify
from ucp.secure.envelope import CLEAR, REVOCATION, ClearHeader
from ucp.secure.sealed_datagrams import CRYPTO_FUNCTIONS
from ucp.secure.secured_agent import SecuredAgent, make_boot
from ucp.secure.session import Session

QUERY = RequestForBlock(bytes(32))
BOOT = make_boot(1, bytes(8))


class CountingAgent(SecuredAgent):
    """Agent 1. It counts the signatures that it verifies."""

    def __init__(self) -> None:
        self.verified = 0
        crypto = replace(CRYPTO_FUNCTIONS, verify=self._verify)
        super().__init__(Session(KEYS.bundle(1), BOOT, crypto=crypto), 1, ROSTER, b"test")

    def _verify(self, claim: UnverifiedSignature) -> bool:
        self.verified += 1
        return verify(claim)

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
