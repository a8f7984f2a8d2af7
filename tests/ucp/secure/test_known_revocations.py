"""Test how an agent combines revocations: a revoked agent stays revoked, whatever the order of the authority's
messages.
"""

import base64
from collections.abc import Sequence
from itertools import permutations
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from tests.ucp.secure.swarm import KEYS, agent
from ucp.messages import RequestForBlock
from ucp.secure._known_revocations import KnownRevocations
from ucp.secure.envelope import REVOCATION
from ucp.secure.revocation import Revocation, revocations_digest
from ucp.secure.secured_agent import REVOCATION_INTERVAL_S, SecuredAgent
from ucp.store import SecuredState, Store, StoredState

AUTHORITY = Ed25519PrivateKey.from_private_bytes(KEYS.authority)


def body(number: int, *agents: int) -> bytes:
    return Revocation.signed(AUTHORITY, KEYS.public.mission, number, agents).encode()


def revocations_in(datagrams: Sequence[bytes]) -> int:
    return sum(datagram[3] == REVOCATION for datagram in datagrams)


def is_heard(listener: SecuredAgent, sender: SecuredAgent, sequence: int) -> bool:
    before = listener.received.total()
    listener.receive_datagram(sender.session.seal(sequence, RequestForBlock(bytes(32)), None, None, 0), 0.0)
    return listener.received.total() > before


def test_later_revocation_of_another_agent_does_not_restore_the_first() -> None:
    one, two, three = agent(1), agent(2), agent(3)
    one.revoke(body(5, 3), 0.0)
    one.revoke(body(6, 2), 0.0)
    assert not is_heard(one, three, 0)
    assert not is_heard(one, two, 0)


@pytest.mark.parametrize("order", [*permutations((body(5, 28), body(6, 1), body(1, 1, 7)))])
def test_revocations_unite_in_any_order_and_with_copies(order: Sequence[bytes]) -> None:
    known = KnownRevocations(KEYS.public.authority, KEYS.public.mission)
    for each in (*order, *order):
        known.add(each)
    assert known.revoked == {1, 7, 28}
    assert known.digest == revocations_digest([28, 7, 1])
    again = KnownRevocations(KEYS.public.authority, KEYS.public.mission)
    again.restore((b"damaged", *known.bodies))
    assert (again.revoked, again.digest) == (known.revoked, known.digest)


def test_agents_with_different_revocations_unite_them() -> None:
    one, two = agent(1), agent(2)
    one.revoke(body(5, 3), 0.0)
    two.revoke(body(6, 28), 0.0)
    one.datagrams_to_send(), two.datagrams_to_send()
    now = REVOCATION_INTERVAL_S
    for listener, sender in ((one, two), (two, one)):
        digest = sender._revocations.digest
        query = sender.session.seal(0, RequestForBlock(bytes(32)), None, None, digest)
        listener.receive_datagram(query, now)
        for datagram in listener.datagrams_to_send():
            sender.receive_datagram(datagram, now)
    assert one.revoked == two.revoked == {3, 28}


def test_agents_with_equal_revocations_send_none() -> None:
    one, two = agent(1), agent(2)
    for each in (one, two):
        each.revoke(body(1, 3), 0.0)
        assert revocations_in(each.datagrams_to_send()) == 1
    query = two.session.seal(0, RequestForBlock(bytes(32)), None, None, revocations_digest([3]))
    one.receive_datagram(query, REVOCATION_INTERVAL_S)
    assert revocations_in(one.datagrams_to_send()) == 0


def test_store_keeps_the_union_and_reads_that_of_earlier_versions(tmp_path: Path) -> None:
    one = agent(1)
    store = Store(tmp_path / "1.store", one.state)
    for number, revoked in enumerate((3, 28), 5):
        one.revoke(body(number, revoked), 0.0)
        store.write([], one.secured_state())
    store.close()
    recovered = Store(tmp_path / "1.store", agent(1).state).recovered
    assert recovered is not None
    after = agent(1, started_us=9)
    after.boot(recovered, 1.0)
    assert after.revoked == {3, 28}
    assert after.sign_head(0)["revoked"] == [3, 28]
    earlier = SecuredState(0)
    earlier.replay({"started_us": 5, "revocation": base64.b64encode(body(1, 3)).decode()})
    after = agent(1, started_us=9)
    after.boot(StoredState(secured=earlier), 1.0)
    assert after.revoked == {3}
