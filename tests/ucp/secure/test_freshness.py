"""Test vehicles that lost their replay windows, their clock or their disk.

Such a vehicle accepts no recorded datagrams, and other vehicles accept its datagrams.
"""

from collections.abc import Iterable
from dataclasses import replace
from itertools import count

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from tests.ucp.secure.swarm import KEYS, ROSTER
from ucp.messages import RequestForBlock
from ucp.secure._challenges import CHALLENGE_INTERVAL_S, TRUST_DELAY_S
from ucp.secure._epochs import MAX_EPOCHS_AHEAD, MAX_EPOCHS_FOLLOWED
from ucp.secure.bundle import Bundle
from ucp.secure.crypto_suite import UnverifiedSignature, verify
from ucp.secure.envelope import CHALLENGE, ECHO
from ucp.secure.revocation import Revocation
from ucp.secure.secured_agent import SecuredAgent, make_boot
from ucp.secure.session import Session

EPOCH_S = KEYS.public.epoch_s
LOST_CLOCK_S = -1_795_000_000.0
"""The mission second of a clock that shows the year 1970."""
QUERY = RequestForBlock(bytes(32))
SEQUENCES = count(100)


def born(agent_id: int, started_us: int = 1, bundle: Bundle | None = None, now: float = 0.0) -> SecuredAgent:
    session = Session(bundle or KEYS.bundle(agent_id), make_boot(started_us, bytes(8)))
    agent = SecuredAgent(session, agent_id, ROSTER, b"test")
    session.set_clock(now)
    return agent


def rebooted(agent_id: int, started_us: int = 9, now: float = 0.0) -> SecuredAgent:
    """Return an agent that took part in the mission before, and lost everything except its bundle."""
    return born(agent_id, started_us, KEYS.bundle(agent_id).used(), now)


def query(sender: SecuredAgent) -> bytes:
    return sender.session.seal(next(SEQUENCES), QUERY, None, None, sender._revocations.digest)


def hears(listener: SecuredAgent, datagram: bytes, now: float) -> bool:
    before = listener.received.total()
    listener.receive_datagram(datagram, now)
    return listener.received.total() > before


def settle(clocks: dict[SecuredAgent, float], *, lost: Iterable[SecuredAgent] = ()) -> None:
    """Deliver all datagrams to all other agents until no agent sends any. Each agent has its own clock, in mission
    seconds.
    """
    for _ in range(10):
        sent = [(agent, agent.datagrams_to_send()) for agent in clocks]
        for sender, datagrams in sent:
            for datagram in datagrams:
                for listener, now in clocks.items():
                    if listener is not sender and sender not in lost:
                        listener.receive_datagram(datagram, now)
        if not any(datagrams for _, datagrams in sent):
            return
    raise AssertionError("the agents send without end")


def test_rebooted_vehicle_accepts_no_recorded_datagram() -> None:
    two, three = born(2), born(3)
    recorded = [query(two) for _ in range(300)]
    one = rebooted(1, now=30.0)
    assert sum(hears(one, datagram, 30.0) for datagram in recorded) == 0
    assert one.dropped == {"not confirmed": 300}
    settle({one: 30.0, two: 30.0, three: 30.0})
    assert sum(hears(one, datagram, 31.0) for datagram in recorded) == 0
    assert hears(one, query(two), 31.0)
    assert hears(one, query(three), 31.0)
    assert hears(two, query(one), 31.0)


def test_vehicle_that_flew_before_asks_at_its_first_datagram() -> None:
    one = rebooted(1)
    one.begin_reconcile(0.0)
    challenge, *_ = one.datagrams_to_send()
    assert challenge[3] == CHALLENGE
    assert not any(datagram[3] == CHALLENGE for datagram in _datagrams_of_a_reconcile(born(1)))


def _datagrams_of_a_reconcile(agent: SecuredAgent) -> list[bytes]:
    agent.begin_reconcile(0.0)
    return agent.datagrams_to_send()


def test_fresh_bundle_late_in_the_mission_proves_no_first_start() -> None:
    two = born(2)
    one = born(1, now=EPOCH_S)
    assert not hears(one, query(two), EPOCH_S)
    assert one.dropped == {"not confirmed": 1}


def test_vehicle_without_clock_is_heard_and_hears_others() -> None:
    """The vehicle's clock shows 1970. Its bundle has the epoch in which the vehicle was lost, five epochs before the
    present.
    """
    now = 9.5 * EPOCH_S
    two, three = born(2), born(3)
    for each in (two, three):
        each.session.set_clock(now)
    before = born(1)
    before.session.set_clock(4.5 * EPOCH_S)
    recorded = query(two)
    one = born(1, 9, before.session.epochs.bundle, LOST_CLOCK_S)
    assert not hears(one, recorded, LOST_CLOCK_S)
    settle({one: LOST_CLOCK_S, two: now, three: now})
    assert not hears(one, recorded, LOST_CLOCK_S)
    assert hears(one, query(two), LOST_CLOCK_S)
    assert hears(two, query(one), now)
    assert one.session.epochs.current == 9


def test_epochs_pass_although_the_clock_shows_1970() -> None:
    one = rebooted(1, now=LOST_CLOCK_S)
    one.session.set_clock(LOST_CLOCK_S + 2.5 * EPOCH_S)
    assert one.session.epochs.bundle.epoch == 2


def test_vehicle_with_an_earlier_boot_is_heard_after_an_echo() -> None:
    """The vehicle lost its clock and its disk. Its boot is therefore earlier than that of its last incarnation."""
    two, before, after = born(2), born(1, started_us=77), rebooted(1, started_us=3)
    recorded = query(before)
    assert hears(two, query(before), 0.0)
    assert not hears(two, query(after), 0.0)
    assert two.dropped == {"old boot": 1}
    settle({two: 0.0, after: 0.0})
    assert hears(two, query(after), 0.0)
    assert not hears(two, recorded, CHALLENGE_INTERVAL_S), "a datagram of the lost incarnation that two never received"
    assert hears(two, query(after), CHALLENGE_INTERVAL_S)


def test_recorded_boot_is_not_restored_by_a_recorded_echo() -> None:
    two, before = born(2), born(1, started_us=3)
    recorded = query(before)
    later = born(1, started_us=77)
    assert hears(two, query(later), 0.0)
    assert not hears(two, recorded, 0.0)
    (challenge,) = two.datagrams_to_send()
    later.receive_datagram(challenge, 0.0)
    (echo,) = later.datagrams_to_send()
    assert echo[3] == ECHO
    two.receive_datagram(echo, 0.0)
    assert not hears(two, recorded, CHALLENGE_INTERVAL_S)
    two.datagrams_to_send()
    two.receive_datagram(echo, CHALLENGE_INTERVAL_S)
    assert two.dropped["answers no request"] == 1
    assert hears(two, query(later), CHALLENGE_INTERVAL_S)


def test_repeated_challenge_is_echoed_once() -> None:
    one, two = rebooted(1), born(2)
    one.begin_reconcile(0.0)
    challenge, *_ = one.datagrams_to_send()
    for _ in range(100):
        two.receive_datagram(challenge, 0.0)
    assert len(two.datagrams_to_send()) == 1
    stranger = rebooted(3)
    for number in range(100):
        stranger.receive_datagram(challenge, float(number))
    assert sum(datagram[3] == ECHO for datagram in stranger.datagrams_to_send()) == 1


def test_recorded_challenges_and_echoes_cost_one_signature_each() -> None:
    verified = list[UnverifiedSignature]()

    def counts(claim: UnverifiedSignature) -> bool:
        verified.append(claim)
        return verify(claim)

    one, two = rebooted(1), born(2)
    one.session.crypto = replace(one.session.crypto, verify=counts)
    hears(one, query(two), 0.0)
    (challenge,) = one.datagrams_to_send()
    two.receive_datagram(challenge, 0.0)
    two.session.challenges.ask(3, 0.0)
    to_three, echo = two.datagrams_to_send()
    for number in range(50):
        one.receive_datagram(echo, number / 10)
        one.receive_datagram(to_three, number / 10)
    assert len(verified) == 2
    assert one.dropped == {"not confirmed": 1, "answers no request": 49, "replayed": 49}


def test_recorded_echo_does_not_replace_a_later_boot() -> None:
    one, before = rebooted(1), born(2, started_us=3)
    hears(one, query(before), 0.0)
    (challenge,) = one.datagrams_to_send()
    before.receive_datagram(challenge, 0.0)
    (echo,) = before.datagrams_to_send()
    one.receive_datagram(echo, 0.0)
    recorded = [query(before) for _ in range(5)]
    assert all(hears(one, datagram, TRUST_DELAY_S) for datagram in recorded)
    later = born(2, started_us=77)
    assert hears(one, query(later), TRUST_DELAY_S)
    one.receive_datagram(echo, TRUST_DELAY_S)
    assert not any(hears(one, datagram, TRUST_DELAY_S) for datagram in recorded)
    assert hears(one, query(later), TRUST_DELAY_S)


def test_delayed_echo_does_not_replace_a_later_boot() -> None:
    """The attacker holds the echo back until the receiver has accepted a later incarnation."""
    one, before = born(1), born(2, started_us=3)
    assert hears(one, query(born(2, started_us=5)), 0.0)
    assert not hears(one, query(before), 0.0)
    (challenge,) = one.datagrams_to_send()
    before.receive_datagram(challenge, 0.0)
    (echo,) = before.datagrams_to_send()
    later = born(2, started_us=77)
    assert hears(one, query(later), 0.0)
    one.receive_datagram(echo, 0.0)
    assert hears(one, query(later), 0.0)


def test_recorded_challenges_do_not_keep_restarted_vehicles_apart() -> None:
    one, two = rebooted(1), rebooted(2)
    recorded = list[bytes]()
    for started_us in range(3):
        before = rebooted(2, started_us)
        before.begin_reconcile(0.0)
        recorded.append(before.datagrams_to_send()[0])
    now = 0.0
    while not hears(two, query(one), now):
        now += 0.05
        assert now < 2 * CHALLENGE_INTERVAL_S, "an answer to each genuine challenge comes at once"
        for datagram in recorded:
            one.receive_datagram(datagram, now)
        settle({one: now, two: now})


def test_insider_cannot_echo_for_another_vehicle() -> None:
    one, two, insider = rebooted(1), born(2), born(3)
    insider.session.agent_id = 2
    hears(one, query(two), 0.0)
    (challenge,) = one.datagrams_to_send()
    insider.receive_datagram(challenge, 0.0)
    (echo,) = insider.datagrams_to_send()
    one.receive_datagram(echo, 0.0)
    assert one.dropped["not signed by its sender"] == 1
    assert not hears(one, query(two), TRUST_DELAY_S)


def test_far_epoch_of_a_captured_vehicle_cuts_off_no_vehicle() -> None:
    clocks = {born(1): 0.0, born(2): 3 * EPOCH_S, born(3): 5 * EPOCH_S}
    for agent, now in clocks.items():
        agent.session.set_clock(now)
    one, two, captured = clocks
    for epoch in (8, 100, MAX_EPOCHS_AHEAD, 2**32 - 1):
        captured.session.epochs._followed = epoch
        if epoch <= MAX_EPOCHS_AHEAD:
            assert hears(two, query(captured), clocks[two])
        assert hears(one, query(two), clocks[one])
        assert hears(two, query(one), clocks[two])
    assert [agent.session.epochs.bundle.epoch for agent in (one, two)] == [0, 3]


def test_vehicle_follows_a_far_epoch_so_far_that_slow_clocks_can_open_it() -> None:
    one, two, captured = born(1), born(2), born(3)
    captured.session.epochs._followed = two.session.epochs.bundle.epoch + MAX_EPOCHS_AHEAD + 5
    two.session.set_clock(5 * EPOCH_S)
    assert hears(two, query(captured), 5 * EPOCH_S)
    assert two.session.epochs.current == 5 + MAX_EPOCHS_FOLLOWED
    assert hears(one, query(two), 0.0)


def test_vehicle_without_store_learns_revocations_before_it_trusts() -> None:
    two, three = born(2), born(3)
    authority = Ed25519PrivateKey.from_private_bytes(KEYS.authority)
    two.revoke(Revocation.signed(authority, KEYS.public.mission, 1, [3]).encode(), 0.0)
    two.datagrams_to_send()
    one = rebooted(1)
    hears(one, query(three), 0.0)
    (challenge,) = one.datagrams_to_send()
    three.receive_datagram(challenge, 0.0)
    for datagram in three.datagrams_to_send():
        one.receive_datagram(datagram, 0.0)
    assert not hears(one, query(three), 0.0), "the revoked vehicle answers first"
    two.receive_datagram(challenge, 0.0)
    for datagram in two.datagrams_to_send():
        one.receive_datagram(datagram, 0.0)
    assert one.revoked == {3}
    assert not hears(one, query(three), TRUST_DELAY_S)
    assert hears(one, query(two), TRUST_DELAY_S)


def test_vehicle_trusts_the_only_vehicle_in_range_after_a_delay() -> None:
    one, two = rebooted(1), born(2)
    hears(one, query(two), 0.0)
    settle({one: 0.0, two: 0.0})
    assert not hears(one, query(two), TRUST_DELAY_S / 2)
    assert hears(one, query(two), TRUST_DELAY_S)


def test_lost_challenge_is_repeated() -> None:
    one, two = rebooted(1), born(2)
    hears(one, query(two), 0.0)
    assert len(one.datagrams_to_send()) == 1
    hears(one, query(two), CHALLENGE_INTERVAL_S / 2)
    assert one.datagrams_to_send() == []
    hears(one, query(two), CHALLENGE_INTERVAL_S)
    settle({one: CHALLENGE_INTERVAL_S, two: CHALLENGE_INTERVAL_S})
    assert hears(one, query(two), CHALLENGE_INTERVAL_S + TRUST_DELAY_S)


def test_each_start_is_recorded_in_the_bundle() -> None:
    kept: list[Bundle] = []
    Session(KEYS.bundle(1), make_boot(5, bytes(8)), kept.append)
    assert kept == [replace(KEYS.bundle(1), started_us=5)]
    assert Bundle.from_json(kept[0].to_json()) == kept[0]
