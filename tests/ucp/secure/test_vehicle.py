"""A secured agent on its vehicle: its bundle, its store, its export, and what it leaves on disk."""

import base64
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from tests.ucp.secure.swarm import KEYS, ROSTER, agent, completes_a_block, secrets_of
from tests.ucp.test_node import AgentUnderTest, mission
from ucp.export import export_chain
from ucp.mission import Mission, MissionError, parse_mission
from ucp.secure._secured_vehicle import secured_agent
from ucp.secure.block_signature import claim_of_block
from ucp.secure.bundle import bundle_name, load_bundle, write_bundle
from ucp.secure.crypto_suite import verify
from ucp.secure.revocation import Revocation
from ucp.store import SecuredState, Store


def secured(agent_id: int = 1) -> Mission:
    security = {"bundle": bundle_name(agent_id)}
    return parse_mission(mission(agent_id=agent_id, roster=list(ROSTER), security=security, features=["secured"]))


def quiet(error: OSError) -> None:
    raise error


def test_old_secrets_are_erased_on_disk_when_an_epoch_ends(tmp_path: Path) -> None:
    path = tmp_path / bundle_name(1)
    write_bundle(path, KEYS.bundle(1))
    first = load_bundle(path).group_secret.hex()
    made = secured_agent(secured(), tmp_path, quiet)(1, ROSTER, b"test")
    made.session.epochs.look_at(KEYS.public.epoch_s * 3)
    assert load_bundle(path).epoch == 3
    assert first not in path.read_text()
    assert path.stat().st_mode & 0o777 == 0o600
    again = secured_agent(secured(), tmp_path, quiet)(1, ROSTER, b"test")
    assert again.session.epochs.current == 3
    assert again.session.boot != made.session.boot


def test_a_bundle_that_is_not_this_agents_is_refused_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / bundle_name(1)
    write_bundle(path, KEYS.bundle(2))
    with pytest.raises(MissionError, match="is agent 2's: hand out the bundle of agent 1"):
        secured_agent(secured(), tmp_path, quiet)
    write_bundle(path, KEYS.bundle(1))
    stranger = replace(secured(), roster=(*ROSTER, 9))
    with pytest.raises(MissionError, match="no keys of agent 9"):
        secured_agent(stranger, tmp_path, quiet)
    path.chmod(0o644)
    with pytest.raises(MissionError, match="other users can read this secret") as refused:
        secured_agent(secured(), tmp_path, quiet)
    assert not any(secret.hex() in str(refused.value) for secret in secrets_of(KEYS.bundle(1)))


def test_a_store_keeps_signatures_and_when_the_life_began(tmp_path: Path) -> None:
    one = agent(1, started_us=77)
    store = Store(tmp_path / "1.store", one.state)
    store.write([], one.secured_state())  # nothing has changed, and still nobody hears of this life before the disk
    store.close()
    assert Store(tmp_path / "1.store", agent(1).state).recovered.secured == SecuredState(77)  # type: ignore[union-attr]
    store = Store(tmp_path / "2.store", one.state)
    completes_a_block(one)
    changes = [change for entry in one.trace() for change in getattr(entry, "changes", ())]
    body = Revocation.signed(Ed25519PrivateKey.from_private_bytes(KEYS.authority), KEYS.public.mission, 1, [3]).encode()
    store.write(changes, one.secured_state())
    one.revoke(body, 1.0)
    store.write([], one.secured_state())
    store.write([], one.secured_state())
    store.close()
    assert len((tmp_path / "2.store").read_bytes().splitlines()) == 3
    assert Store(tmp_path / "2.store", agent(1).state).recovered.secured == one.secured_state()  # type: ignore[union-attr]


def test_an_export_has_the_makers_signatures() -> None:
    one = agent(1)
    completes_a_block(one)
    (exported,) = export_chain(one.state, 0, one.signatures)["blocks_to_be_committed"]
    (block,) = one.state.blocks_to_be_committed
    signature = base64.b64decode(exported["signature"])
    assert verify(claim_of_block(KEYS.public.vehicles[1], KEYS.public.mission, block.block_data(), signature))


def test_a_secured_program_serves_and_leaves_no_secret(tmp_path: Path) -> None:
    agents, keys = tmp_path / "agents", tmp_path / "keys"
    agents.mkdir()
    keys.mkdir()
    bundle = KEYS.bundle(1)
    write_bundle(keys / bundle_name(1), bundle)
    security = {"bundle": os.path.relpath(keys / bundle_name(1), agents)}
    under_test = AgentUnderTest(agents, mission(agent_id=1, roster=list(ROSTER), security=security, store="1.store"))
    under_test.start()
    under_test.ask("log", event_id=5, data=base64.b64encode(bytes(200)).decode())
    under_test.process.terminate()
    assert under_test.process.wait(10) == 0
    left = b"".join(path.read_bytes() for path in agents.iterdir())
    assert b'"secured":true' in left
    for secret in (*secrets_of(bundle), *secrets_of(load_bundle(keys / bundle_name(1)))):
        assert secret not in left
        assert secret.hex().encode() not in left
        assert base64.b64encode(secret) not in left


def test_without_its_keys_a_program_ends_with_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "1.mission.json"
    path.write_text(json.dumps(mission(agent_id=1, roster=list(ROSTER), security={"bundle": "none"})))
    ended = subprocess.run([sys.executable, "-m", "ucp.node", str(path)], capture_output=True, text=True, timeout=30)
    assert ended.returncode == 2
    assert ended.stderr.startswith(f"{path}: `security.bundle`: {tmp_path / 'none'}: cannot be read")
    assert ended.stderr.count("\n") == 1
