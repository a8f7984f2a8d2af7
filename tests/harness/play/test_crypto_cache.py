"""Test that the cache of cryptographic results does not hide an agent's errors."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from harness.play.simulation import _crypto_cache as cache
from harness.play.simulation._crypto_cache import RecordedSignatures, cached_crypto
from harness.run.simulate import Simulated, simulate
from tests.harness.virtual import scenario
from ucp.block import Block
from ucp.messages import BlockAddRequest, CommitBlock, MalformedDatagramError
from ucp.secure._window import ReplayWindow
from ucp.secure.block_signature import sign_block
from ucp.secure.bundle import Bundle, KeySet
from ucp.secure.crypto_suite import UnverifiedSignature, verify
from ucp.secure.sealed_datagrams import CryptoFunctions
from ucp.secure.secured_agent import SecuredAgent, make_boot
from ucp.secure.session import Session

ROSTER = (1, 2, 3, 4)
KEYS = KeySet.derived(bytes(32), ROSTER)
OTHERS = KeySet.derived(bytes(31) + b"1", ROSTER)
QUESTION = BlockAddRequest(bytes(32), bytes(32))


def session(bundle: Bundle, crypto: CryptoFunctions) -> Session:
    return Session(bundle, make_boot(1, bytes(8)), crypto=crypto)


def sealed(bundle: Bundle, crypto: CryptoFunctions, sequence: int = 0) -> bytes:
    return session(bundle, crypto).seal(sequence, QUESTION, None, None, 0)


def result_of(datagram: bytes, receiver: Session) -> str:
    try:
        return type(receiver.open(datagram, receiver.crypto.read(datagram), 0.0).datagram.message).__name__
    except MalformedDatagramError as dropped:
        return dropped.reason


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (replace(KEYS.bundle(2), group_secret=OTHERS.group_secret), "not authentic"),
        (replace(KEYS.bundle(2), public=replace(KEYS.public, mission=bytes(16))), "not authentic"),
        (
            replace(KEYS.bundle(2), public=replace(KEYS.public, vehicles=OTHERS.public.vehicles)),
            "not signed by its sender",
        ),
    ],
    ids=["another secret", "another mission", "another public key"],
)
def test_agent_with_wrong_keys_opens_no_cached_datagram(wrong: Bundle, reason: str) -> None:
    crypto = cached_crypto()
    datagram = sealed(KEYS.bundle(1), crypto)
    right, again, other = (session(bundle, crypto) for bundle in (KEYS.bundle(3), KEYS.bundle(4), wrong))
    results = [result_of(datagram, receiver) for receiver in (right, other, again)]
    assert results == ["BlockAddRequest", reason, "BlockAddRequest"]


def test_changed_bytes_do_not_use_the_cache() -> None:
    crypto = cached_crypto()
    datagram = sealed(KEYS.bundle(1), crypto)
    assert result_of(datagram, session(KEYS.bundle(2), crypto)) == "BlockAddRequest"
    for place in range(len(datagram)):
        changed = bytearray(datagram)
        changed[place] ^= 1
        receiver = session(KEYS.bundle(3), crypto)
        receiver.public_keys = dict.fromkeys(range(2**16), KEYS.public.vehicles[1])
        assert result_of(bytes(changed), receiver) != "BlockAddRequest"


def test_each_receiver_has_its_own_replay_window() -> None:
    crypto = cached_crypto()
    datagram = sealed(KEYS.bundle(1), crypto)
    for agent_id in (2, 3):
        receiver = session(KEYS.bundle(agent_id), crypto)
        assert result_of(datagram, receiver) == "BlockAddRequest"
        assert result_of(datagram, receiver) == "replayed"


def test_cached_verification_equals_the_library() -> None:
    signatures = RecordedSignatures()
    makers = {agent_id: signatures.signer(KEYS.vehicles[agent_id]) for agent_id in (1, 2)}
    made = [
        UnverifiedSignature(KEYS.public.vehicles[each], makers[each].sign(data), data)
        for each in (1, 2)
        for data in (b"a", b"b")
    ]
    for one in made:
        for two in made:
            for three in made:
                claim = UnverifiedSignature(one.public_key, two.signature, three.signed)
                assert signatures.verified(claim) == verify(claim) == (claim in made)


def test_signature_of_another_process_is_verified() -> None:
    maker, here = RecordedSignatures().signer(KEYS.vehicles[1]), RecordedSignatures()
    claim = UnverifiedSignature(KEYS.public.vehicles[1], maker.sign(b"a"), b"a")
    assert here.verified(claim)
    assert not here.verified(claim._replace(signed=b"b"))


def test_library_with_wrong_signatures_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "verify", lambda claim: False)
    signatures = RecordedSignatures()
    maker = signatures.signer(KEYS.vehicles[1])
    claims = [
        UnverifiedSignature(KEYS.public.vehicles[1], maker.sign(data), data) for data in map(bytes, range(1, 300))
    ]
    assert not all(map(signatures.verified, claims))


def test_full_cache_drops_entries_and_stays_correct(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "SIGNATURES_CACHED", 2)
    signatures = RecordedSignatures()
    maker = signatures.signer(KEYS.vehicles[1])
    claims = [UnverifiedSignature(KEYS.public.vehicles[1], maker.sign(data), data) for data in (b"a", b"b", b"c", b"d")]
    assert all(map(signatures.verified, claims))
    assert len(signatures._made) == 2


# Missions in which one of five vehicles is wrong


def played(monkeypatch: pytest.MonkeyPatch, agent_id: int, spoil: Callable[[SecuredAgent], None]) -> Simulated:
    """Play a mission with one agent that the function `spoil` has changed."""
    init = SecuredAgent.__init__

    def spoiled(agent: SecuredAgent, *arguments: Any, **options: Any) -> None:
        init(agent, *arguments, **options)
        if agent.agent_id == agent_id:
            spoil(agent)

    monkeypatch.setattr(SecuredAgent, "__init__", spoiled)
    return simulate(scenario(duration_s=200, events={"mean_s": 10}).secured(), 1, tracing=True)


def dropped(run: Simulated) -> dict[str, set[str]]:
    return {agent_id: set(agent.dropped or ()) for agent_id, agent in run.played.agents.items()}


def only_at(agent_id: int, *reasons: str) -> dict[str, set[str]]:
    return {str(each): set(reasons) if each == agent_id else set() for each in range(1, 6)}


def except_at(agent_id: int, *reasons: str) -> dict[str, set[str]]:
    return {str(each): set() if each == agent_id else set(reasons) for each in range(1, 6)}


def test_correct_mission_drops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert dropped(played(monkeypatch, 3, lambda agent: None)) == only_at(3)


def test_wrong_public_key_causes_drops(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(agent: SecuredAgent) -> None:
        agent.session.public_keys = {**agent.session.public_keys, 1: agent.session.public_keys[2]}

    assert dropped(played(monkeypatch, 3, spoil))["3"] >= {"not signed by its sender"}


def test_wrong_verification_causes_drops(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(agent: SecuredAgent) -> None:
        agent.session.crypto = replace(agent.session.crypto, verify=lambda claim: False)

    assert dropped(played(monkeypatch, 3, spoil)) == only_at(3, "not signed by its sender")


def test_wrong_replay_window_causes_drops(monkeypatch: pytest.MonkeyPatch) -> None:
    class Narrow(ReplayWindow):
        __slots__ = ()

        def is_fresh(self, sequence: int) -> bool:
            return self._newest < 0

    def spoil(agent: SecuredAgent) -> None:
        authentic = agent.session._authenticate

        def narrowed(*arguments: Any) -> bytes:
            body = authentic(*arguments)
            for life in agent.session._incarnations.values():
                life.window.__class__ = Narrow
            return body

        monkeypatch.setattr(agent.session, "_authenticate", narrowed)

    assert dropped(played(monkeypatch, 3, spoil))["3"] >= {"replayed"}


def test_signature_of_other_bytes_causes_drops(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(agent: SecuredAgent) -> None:
        sign = agent.session.private_key.sign
        monkeypatch.setattr(agent.session.private_key, "sign", lambda data: sign(data + b"!"))

    assert dropped(played(monkeypatch, 3, spoil))["1"] == {"not signed by its sender"}


def test_signature_with_another_key_causes_drops(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(agent: SecuredAgent) -> None:
        agent.session.private_key = agent.session.crypto.signer(bytes(32))

    assert dropped(played(monkeypatch, 3, spoil))["1"] == {"not signed by its sender"}


def test_seal_for_another_epoch_causes_drops(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(agent: SecuredAgent) -> None:
        epochs = agent.session.epochs
        epochs._bundle = epochs._bundle.at_epoch(0, bytes(32))

    run = played(monkeypatch, 3, spoil)
    assert dropped(run) == {**except_at(3, "not authentic"), "3": {"not authentic"}}


def test_block_in_another_agents_name_is_dropped_despite_the_cache() -> None:
    crypto = cached_crypto()
    maker, receiver = (
        SecuredAgent(session(KEYS.bundle(agent_id), crypto), agent_id, ROSTER, b"test") for agent_id in (1, 2)
    )
    block = Block(3, 1, b"x")
    signature = sign_block(maker.session.private_key, KEYS.public.mission, block.block_data())
    receiver.receive_datagram(maker.session.seal(0, CommitBlock(block, bytes(32)), None, signature, 0), 0.0)
    assert receiver.dropped == {"block not signed by its maker": 1}
