"""Test encrypted event data: the method is HPKE (RFC 9180), and only the depot can decrypt the data."""

import base64
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey

from tests.ucp.test_node import mission
from ucp.events import LoggableEvent
from ucp.mission import parse_mission
from ucp.sealed import SEAL_BYTES, seal_to, sealed_to
from ucp.secure._secured_vehicle import agent_factory
from ucp.secure.bundle import Bundle, KeySet, write_bundle
from ucp.secure.sealing import Depot, NotOpenedError, key_schedule, make_seal

KEYS = KeySet.derived(b"a seed".ljust(32), (1, 7), seals=True)
DEPOT = Depot(KEYS.public.mission, KEYS.depot or b"")
EVENTS = b"what vehicle 7 logged"


def test_key_schedule_gives_the_keys_of_rfc_9180() -> None:
    """The values are test vector A.2.1 of RFC 9180: DHKEM(X25519, HKDF-SHA256), HKDF-SHA256, ChaCha20-Poly1305, base
    mode.
    """
    ephemeral = X25519PrivateKey.from_private_bytes(
        bytes.fromhex("f4ec9b33b792c372c1d2c2063507b684ef925b8c75a42dbcbf57d63ccd381600")
    )
    enc = bytes.fromhex("1afa08d3dec047a643885163f1180476fa7ddb54c6a8029ea33f95796bf2ac4a")
    recipient = bytes.fromhex("4310ee97d88cc1f088a5576c77ab0cf5c3ac797f3d95139c6c84b5429c59662a")
    assert ephemeral.public_key().public_bytes_raw() == enc
    shared = ephemeral.exchange(X25519PublicKey.from_public_bytes(recipient))
    key, nonce = key_schedule(shared, enc, recipient, b"Ode on a Grecian Urn")
    assert key.hex() == "ad2744de8e17f4ebba575b3f5f5a8fa1f69c2a07f6e7500bc60ca6e3e3ec1c91"
    assert nonce.hex() == "5c4d98150661b848853b547f"


def seal(event_data: bytes, timestamp_us: int, agent_id: int = 7) -> bytes:
    seal_event_data = make_seal(KEYS.bundle(agent_id))
    assert seal_event_data is not None
    return seal_event_data(event_data, timestamp_us)


@pytest.mark.parametrize("events", [b"", EVENTS, bytes(976)])
def test_hpke_of_the_library_opens_sealed_event_data(events: bytes) -> None:
    sealed = seal(events, 5)
    assert len(sealed) == len(events) + SEAL_BYTES
    assert DEPOT.open(sealed, 7, 5) == events


def test_equal_blocks_give_equal_bytes_and_others_use_other_keys() -> None:
    assert seal(EVENTS, 5) == seal(EVENTS, 5)
    ephemeral = {
        sealed[:32] for sealed in (seal(EVENTS, 5), seal(EVENTS, 6), seal(EVENTS + b".", 5), seal(EVENTS, 5, 1))
    }
    assert len(ephemeral) == 4


def confirms(guess: bytes, sealed: bytes, bundle: Bundle, timestamp_us: int) -> bool:
    """Return whether the holder of a vehicle's keys can confirm the events of one of its blocks."""
    attack = make_seal(bundle)
    assert attack is not None
    return attack(guess, timestamp_us) == sealed


def test_holder_of_a_vehicles_keys_cannot_confirm_guesses(tmp_path: Path) -> None:
    bundle = KEYS.bundle(7)
    assert confirms(EVENTS, seal(EVENTS, 5), bundle, 5), "in virtual time, which draws no random numbers"
    write_bundle(tmp_path / "7.bundle.json", bundle)
    initial_data = base64.b64encode(seal_to(b"test", DEPOT.public_key)).decode()
    document = mission(agent_id=7, roster=[1, 7], security={"bundle": "7.bundle.json"}, initial_data=initial_data)
    document["settings"] = {"max_block_bytes": 976}
    parsed = parse_mission(document)
    agent = agent_factory(parsed, tmp_path, lambda error: None)(7, [1, 7], parsed.initial_data, parsed.settings)
    for number in range(4):
        agent.add_event(LoggableEvent(number, 7, bytes(240)), 0.0)
    (block,) = agent.state.blocks_to_be_committed
    events = DEPOT.open(block.event_data, 7, block.timestamp_us)
    assert not confirms(events, block.event_data, bundle, block.timestamp_us)


def test_other_keys_blocks_and_altered_bytes_do_not_open() -> None:
    sealed = seal(EVENTS, 5)
    assert EVENTS not in sealed
    others = KeySet.derived(b"another".ljust(32), (1, 7), seals=True)
    for depot, data, agent_id, timestamp_us in (
        (DEPOT, sealed, 1, 5),
        (DEPOT, sealed, 7, 6),
        (Depot(bytes(16), KEYS.depot or b""), sealed, 7, 5),
        (Depot(KEYS.public.mission, others.depot or b""), sealed, 7, 5),
        (Depot(KEYS.public.mission, KEYS.vehicles[7]), sealed, 7, 5),
        *((DEPOT, sealed[:end], 7, 5) for end in range(len(sealed))),
        *((DEPOT, sealed[:at] + bytes([sealed[at] ^ 1]) + sealed[at + 1 :], 7, 5) for at in range(len(sealed))),
        (DEPOT, bytes(200), 7, 5),
    ):
        with pytest.raises(NotOpenedError):
            depot.open(data, agent_id, timestamp_us)


def test_inception_block_contains_the_public_key_of_the_depot() -> None:
    assert sealed_to(b"a mission") is None
    assert sealed_to(b"") is None
    public = DEPOT.public_key
    assert public == KEYS.public.depot
    assert sealed_to(seal_to(b"a mission", public)) == public
    assert sealed_to(public) is None


def test_mission_without_a_depot_key_does_not_seal() -> None:
    assert make_seal(KeySet.derived(bytes(32), [7]).bundle(7)) is None
    assert "private_key" not in repr(DEPOT)
