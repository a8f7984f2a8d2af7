"""Test the files of an agent with keys: its key file, its store, and its export."""

import base64
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from tests.ucp.secure.swarm import KEYS, ROSTER, agent, complete_a_block, secrets_of
from tests.ucp.test_node import AgentUnderTest, mission
from ucp.export import export_chain
from ucp.mission import Mission, MissionError, parse_mission
from ucp.secure._secured_vehicle import agent_factory
from ucp.secure.block_signature import block_claim
from ucp.secure.bundle import bundle_name, load_bundle, write_bundle
from ucp.secure.crypto_suite import verify
from ucp.secure.revocation import Revocation
from ucp.store import SecuredState, Store


def secured_mission(agent_id: int = 1) -> Mission:
    security = {"bundle": bundle_name(agent_id)}
    return parse_mission(mission(agent_id=agent_id, roster=list(ROSTER), security=security, features=["secured"]))


def raise_write_error(error: OSError) -> None:
    raise error


def test_old_secrets_are_erased_on_disk_when_an_epoch_ends(tmp_path: Path) -> None:
    path = tmp_path / bundle_name(1)
    write_bundle(path, KEYS.bundle(1))
    first = load_bundle(path).group_secret.hex()
    made = agent_factory(secured_mission(), tmp_path, raise_write_error)(1, ROSTER, b"test")
    made.session.set_clock(KEYS.public.epoch_s * 3)
    assert load_bundle(path).epoch == 3
    assert first not in path.read_text()
    assert path.stat().st_mode & 0o777 == 0o600
    again = agent_factory(secured_mission(), tmp_path, raise_write_error)(1, ROSTER, b"test")
    assert again.session.epochs.current == 3
    assert again.session.boot != made.session.boot


def test_bundle_of_another_agent_is_rejected_in_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / bundle_name(1)
    write_bundle(path, KEYS.bundle(2))
    with pytest.raises(MissionError, match="is agent 2's: hand out the bundle of agent 1"):
        agent_factory(secured_mission(), tmp_path, raise_write_error)
    write_bundle(path, KEYS.bundle(1))
    stranger = replace(secured_mission(), roster=(*ROSTER, 9))
    with pytest.raises(MissionError, match="no keys of agent 9"):
        agent_factory(stranger, tmp_path, raise_write_error)
    path.chmod(0o644)
    with pytest.raises(MissionError, match="other users can read this secret") as refused:
        agent_factory(secured_mission(), tmp_path, raise_write_error)
    assert not any(secret.hex() in str(refused.value) for secret in secrets_of(KEYS.bundle(1)))


def test_store_keeps_signatures_and_the_start_of_the_incarnation(tmp_path: Path) -> None:
    one = agent(1, started_us=77)
    store = Store(tmp_path / "1.store", one.state)
    store.write([], one.secured_state())  # the start of the incarnation is stored although no block has changed
    store.close()
    assert Store(tmp_path / "1.store", agent(1).state).recovered.secured == SecuredState(77)  # type: ignore[union-attr]
    store = Store(tmp_path / "2.store", one.state)
    complete_a_block(one)
    changes = [change for entry in one.trace() for change in getattr(entry, "changes", ())]
    body = Revocation.signed(Ed25519PrivateKey.from_private_bytes(KEYS.authority), KEYS.public.mission, 1, [3]).encode()
    store.write(changes, one.secured_state())
    one.revoke(body, 1.0)
    store.write([], one.secured_state())
    store.write([], one.secured_state())
    store.close()
    assert len((tmp_path / "2.store").read_bytes().splitlines()) == 3
    assert Store(tmp_path / "2.store", agent(1).state).recovered.secured == one.secured_state()  # type: ignore[union-attr]


def test_export_contains_the_makers_signatures() -> None:
    one = agent(1)
    complete_a_block(one)
    (exported,) = export_chain(one.state, 0, one.signatures)["blocks_to_be_committed"]
    (block,) = one.state.blocks_to_be_committed
    signature = base64.b64decode(exported["signature"])
    assert verify(block_claim(KEYS.public.vehicles[1], KEYS.public.mission, block.block_data(), signature))


def test_secured_program_leaves_no_secret_in_its_directory(tmp_path: Path) -> None:
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


def test_program_without_its_bundle_ends_with_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "1.mission.json"
    path.write_text(json.dumps(mission(agent_id=1, roster=list(ROSTER), security={"bundle": "none"})))
    ended = subprocess.run([sys.executable, "-m", "ucp.node", str(path)], capture_output=True, text=True, timeout=30)
    assert ended.returncode == 2
    assert ended.stderr.startswith(f"{path}: `security.bundle`: {tmp_path / 'none'}: cannot be read")
    assert ended.stderr.count("\n") == 1
