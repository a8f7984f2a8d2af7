"""Test characteristic 4 with signatures: the checker finds forged and edited blocks without the author's trace."""

import base64
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from tests.harness.command import harness
from ucp.agent import Agent
from ucp.block import Block, next_chain_hash
from ucp.export import export_chain
from ucp.secure.block_signature import sign_block
from ucp.secure.bundle import KeySet, write_public
from ucp.secure.export_head import head_of
from ucp.store import StoredState

SCENARIO = {
    "name": "signed",
    "agents": 3,
    "duration_s": 400,
    "security": {"seal": True},
    "events": {"mean_s": 15},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("signed")
    (directory / "signed.yaml").write_text(json.dumps(SCENARIO))
    done = harness("run", directory / "signed.yaml", "--backend", "sim", "--seed", "1", "--out", directory / "run")
    assert done.returncode == 0, done.stdout + done.stderr
    return directory / "run"


@pytest.fixture
def home(run: Path, tmp_path: Path) -> Path:
    """Return a directory with the exports of agents 1 and 2 and the public keys, without traces or run.json."""
    for name in ("1.chain.json", "2.chain.json"):
        shutil.copy(run / "agents" / name, tmp_path)
    shutil.copy(run / "public.json", tmp_path)
    return tmp_path


def genuine(home: Path, *options: Path | str) -> dict[str, Any]:
    done = harness("check", home, "--json", *options)
    verdict: dict[str, Any] = json.loads(done.stdout)["characteristics"]["4"]
    return verdict


def recompute(export: dict[str, Any]) -> None:
    """Compute all hashes of an export again after its blocks were edited."""
    below = bytes.fromhex(export["inception"]["chain_hash"])
    for block in export["chain"]:
        made = Block(block["agent_id"], block["timestamp_us"], base64.b64decode(block["event_data"]))
        below = next_chain_hash(below, made.block_hash)
        block |= {"block_hash": made.block_hash.hex(), "chain_hash": below.hex()}


def edit_exports(home: Path, edit: Callable[[dict[str, Any]], None]) -> None:
    """Edit the exports of all agents, and compute their hashes again."""
    for path in home.glob("*.chain.json"):
        export = json.loads(path.read_text())
        edit(export)
        recompute(export)
        path.write_text(json.dumps(export))


def edited(home: Path, edit: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Edit a block of agent 3 in agent 1's export, and compute its hashes again. Return the verdict."""
    path = home / "1.chain.json"
    export = json.loads(path.read_text())
    edit(next(block for block in export["chain"] if block["agent_id"] == 3))
    recompute(export)
    path.write_text(json.dumps(export))
    return genuine(home)


def test_signatures_decide_without_the_makers_trace(home: Path, run: Path) -> None:
    for keys in (run, run / "public.json"):
        judgement = genuine(home, "--keys", keys)
        assert judgement["verdict"] == "holds", judgement
        assert "was signed by the agent that it names, with the public keys that --keys names" in judgement["reason"]


def test_vehicle_without_files_counts_as_missing(run: Path, tmp_path: Path) -> None:
    left = shutil.copytree(run, tmp_path / "left")
    for path in (left / "agents").glob("3.*"):
        path.unlink()
    done = harness("check", left, "--keys", run, "--json")
    found = json.loads(done.stdout)["characteristics"]
    for number in "2356":
        assert found[number]["verdict"] == "not applicable", found[number]
        assert "agent 3 is missing" in found[number]["reason"]
    chains = [json.loads(path.read_text())["chain"] for path in (left / "agents").glob("*.chain.json")]
    assert all(any(block["agent_id"] == 3 for block in chain) for chain in chains)
    assert found["4"]["verdict"] == "holds", "the others have its blocks, with its signatures"


def test_keys_beside_the_exports_are_no_anchor(home: Path, tmp_path: Path) -> None:
    judgement = genuine(home)
    assert (judgement["verdict"], judgement["reason"][:12]) == ("not applicable", "not anchored")
    done = harness("consolidate", home, "-o", tmp_path / "out.jsonl")
    assert done.returncode == 0, done.stderr
    assert "not anchored" in done.stdout
    assert "not anchored" in (tmp_path / "out.jsonl").read_text().splitlines()[0]
    assert "not anchored" not in harness("consolidate", home, "--keys", home).stdout


def test_signatures_without_keys_prove_nothing(home: Path) -> None:
    (home / "public.json").unlink()
    assert genuine(home)["verdict"] == "not applicable"


def test_run_without_its_public_keys_is_not_confirmed(run: Path, tmp_path: Path) -> None:
    whole = shutil.copytree(run, tmp_path / "whole")
    assert genuine(whole)["reason"].endswith("with the public keys that run.json names")
    (whole / "public.json").unlink()
    assert genuine(whole)["verdict"] == "not applicable"
    done = harness("check", whole)
    assert done.returncode != 0
    assert "public.json is missing, although the run was secured" in done.stderr
    done = harness("check", whole, "--keys", run)
    assert done.returncode == 0, done.stderr


def _reverse(export: dict[str, Any]) -> None:
    export["chain"].reverse()


def _shuffle(export: dict[str, Any]) -> None:
    export["chain"].sort(key=lambda block: block["signature"])


def _keep(export: dict[str, Any], chain: list[dict[str, Any]]) -> None:
    """Keep only these blocks in the chain and in the list `completed`."""
    kept = {block["block_hash"] for block in chain}
    export["chain"], export["blocks_to_be_committed"], export["reconcile_stack"] = chain, [], []
    export["completed"] = [name for name in export["completed"] if name in kept]


def _truncate(export: dict[str, Any]) -> None:
    _keep(export, export["chain"][:-2])


def _empty(export: dict[str, Any]) -> None:
    _keep(export, [])


def _delete_a_block(export: dict[str, Any]) -> None:
    _keep(export, [block for number, block in enumerate(export["chain"]) if number != 2])


def _hurry(export: dict[str, Any]) -> None:
    export["idle"] = not export["idle"]


REWRITES = (_reverse, _shuffle, _truncate, _empty, _delete_a_block, _hurry)


@pytest.mark.parametrize("rewrite", REWRITES)
def test_rewritten_exports_do_not_match_their_signed_heads(
    home: Path, run: Path, rewrite: Callable[[dict[str, Any]], None]
) -> None:
    edit_exports(home, rewrite)
    for options in ((), ("--keys", run)):
        judgement = genuine(home, *options)
        assert judgement["verdict"] == "violated", judgement
        assert {finding["agent_id"] for finding in judgement["evidence"]} == {1, 2}
        assert all("does not match the head" in finding["detail"] for finding in judgement["evidence"])


def test_removed_heads_prove_nothing(home: Path, run: Path) -> None:
    def remove_head(export: dict[str, Any]) -> None:
        _truncate(export)
        del export["head"]

    edit_exports(home, remove_head)
    judgement = genuine(home, "--keys", run)
    assert (judgement["verdict"], judgement["reason"][:8]) == ("not applicable", "unsigned")


ATTACKER = KeySet.derived(b"an attacker".ljust(32), (1, 2, 3))


def signed_by(attacker: KeySet, export: dict[str, Any], event_data: bytes) -> None:
    """Replace the events of all blocks. Sign the blocks and the export with the attacker's keys."""
    agent = Agent(export["agent_id"], (1, 2, 3), base64.b64decode(export["inception"]["block_data"]))
    mission = attacker.public.mission
    chain, signatures = [], {}
    for old in export["chain"]:
        block = Block(old["agent_id"], old["timestamp_us"], event_data)
        signer = Ed25519PrivateKey.from_private_bytes(attacker.vehicles[block.agent_id])
        signatures[block.block_hash] = sign_block(signer, mission, block.block_data())
        chain.append(block)
    completed = [block.block_hash for block in chain if block.agent_id == agent.agent_id]
    agent.boot(StoredState(completed, chain), 0.0)
    document = export_chain(agent.state, export["exported_at_us"], signatures)
    signer = Ed25519PrivateKey.from_private_bytes(attacker.vehicles[agent.agent_id])
    head = head_of(agent.state, bytes(16), 1, export["exported_at_us"], ())
    export.clear()
    export.update(document, head=head.sign(signer, mission))


def test_reconstruct_names_wrong_signatures(home: Path, run: Path, tmp_path: Path) -> None:
    shutil.copy(run / "agents/1.trace.jsonl", home)
    done = harness("reconstruct", home, "-o", tmp_path / "out.yaml")
    assert "not anchored" in done.stdout
    edit_exports(home, _truncate)
    done = harness("reconstruct", home, "-o", tmp_path / "again.yaml", "--keys", run)
    assert done.returncode == 1
    assert "the export of agent 2 does not match the head that agent 2 signed" in done.stderr


def test_exports_signed_with_the_attackers_keys_are_not_anchored(home: Path, run: Path, tmp_path: Path) -> None:
    edit_exports(home, lambda export: signed_by(ATTACKER, export, b"nothing happened"))
    write_public(home / "public.json", ATTACKER.public)
    judgement = genuine(home)
    assert (judgement["verdict"], judgement["reason"][:12]) == ("not applicable", "not anchored")
    assert genuine(home, "--keys", home)["verdict"] == "holds", "the attacker's own check finds nothing"
    judgement = genuine(home, "--keys", run)
    assert judgement["verdict"] == "violated"
    assert any("does not match the head that agent 1 signed" in each["detail"] for each in judgement["evidence"])
    done = harness("consolidate", home, "--keys", run, "-o", tmp_path / "out.jsonl")
    assert done.returncode == 1
    assert "does not match the key of agent" in done.stderr


def test_run_with_the_attackers_keys_is_noticed(run: Path, tmp_path: Path) -> None:
    whole = shutil.copytree(run, tmp_path / "whole")
    edit_exports(whole / "agents", lambda export: signed_by(ATTACKER, export, b"nothing happened"))
    (whole / "public.json").unlink()
    write_public(whole / "public.json", ATTACKER.public)
    assert genuine(whole)["verdict"] != "holds"
    assert "run.json has 'holds' for characteristic 4" in harness("check", whole).stderr


def test_block_that_a_captured_key_signs_is_found_in_other_exports(home: Path, run: Path) -> None:
    captured = KeySet.derived(hashlib.sha256(b"keys of seed 1").digest(), (1, 2, 3), seals=True)
    block = Block(3, 5, b"never made")
    signer = Ed25519PrivateKey.from_private_bytes(captured.vehicles[3])
    signature = sign_block(signer, captured.public.mission, block.block_data())
    added = {"agent_id": 3, "timestamp_us": 5, "event_data": base64.b64encode(b"never made").decode()}
    added["signature"] = base64.b64encode(signature).decode()
    edit_exports(home, lambda export: export["chain"].append(dict(added)))
    judgement = genuine(home, "--keys", run)
    assert judgement["verdict"] == "violated"
    assert len([each for each in judgement["evidence"] if "does not match the head" in each["detail"]]) == 2


def test_block_that_its_maker_denies_stays_signed_elsewhere(run: Path, home: Path) -> None:
    """Vehicle 1 signs an export that lacks one of its blocks. Vehicle 2 holds this block."""
    keys = KeySet.derived(hashlib.sha256(b"keys of seed 1").digest(), (1, 2, 3), seals=True)
    path = home / "1.chain.json"
    export = json.loads(path.read_text())
    denied = export["completed"][0]
    kept = [block for block in export["chain"] if block["block_hash"] != denied]
    agent = Agent(1, (1, 2, 3), base64.b64decode(export["inception"]["block_data"]))
    blocks = [Block(each["agent_id"], each["timestamp_us"], base64.b64decode(each["event_data"])) for each in kept]
    completed = [bytes.fromhex(name) for name in export["completed"] if name in {each["block_hash"] for each in kept}]
    agent.boot(StoredState(completed, blocks), 0.0)
    signatures = {bytes.fromhex(each["block_hash"]): base64.b64decode(each["signature"]) for each in kept}
    head = head_of(agent.state, bytes(16), 9, export["exported_at_us"], ())
    signer = Ed25519PrivateKey.from_private_bytes(keys.vehicles[1])
    document = export_chain(agent.state, export["exported_at_us"], signatures)
    path.write_text(json.dumps({**document, "head": head.sign(signer, keys.public.mission)}))
    done = harness("consolidate", home, "--keys", run, "-o", home / "record.jsonl")
    assert done.returncode == 0, done.stderr
    lines = map(json.loads, (home / "record.jsonl").read_text().splitlines())
    assert [line["agent_id"] for line in lines if line.get("block_hash") == denied] == [1]


def test_removed_signatures_and_keys_are_unsigned_for_a_reader_with_keys(home: Path, run: Path) -> None:
    def strip(export: dict[str, Any]) -> None:
        del export["head"]
        for block in (*export["chain"], *export["blocks_to_be_committed"], *export["reconcile_stack"]):
            block.pop("signature", None)

    edit_exports(home, strip)
    (home / "public.json").unlink()
    judgement = genuine(home, "--keys", run)
    assert judgement["verdict"] == "violated"
    assert all("without a signature" in finding["detail"] for finding in judgement["evidence"])


def test_older_export_does_not_replace_a_later_one(run: Path, tmp_path: Path) -> None:
    whole = shutil.copytree(run, tmp_path / "whole")
    shutil.copytree(whole / "agents", whole / "before_final_reconcile")
    judgement = genuine(whole)
    assert "is older than the one from before the final reconcile" in judgement["evidence"][0]["detail"]


def test_damaged_public_keys_are_reported(home: Path) -> None:
    (home / "public.json").write_text("{")
    done = harness("check", home)
    assert "public.json: not JSON; signatures of blocks are not checked" in done.stderr


EDITS: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda block: block.pop("signature"), "without a signature"),
    (lambda block: block.update(signature=base64.b64encode(bytes(64)).decode()), "does not match the key of agent 3"),
    (lambda block: block.update(timestamp_us=block["timestamp_us"] + 1), "does not match the key of agent 3"),
    (lambda block: block.update(event_data="AAAA"), "does not match the key of agent 3"),
    (lambda block: block.update(agent_id=2), "does not match the key of agent 2"),
    (lambda block: block.update(agent_id=9), "has no key in this mission"),
]


@pytest.mark.parametrize(("edit", "sentence"), EDITS)
def test_edited_export_is_found(home: Path, edit: Callable[[dict[str, Any]], Any], sentence: str) -> None:
    judgement = edited(home, edit)
    assert judgement["verdict"] == "violated"
    assert any(sentence in finding["detail"] for finding in judgement["evidence"]), judgement


def test_sealed_run_has_no_event_in_its_blocks(run: Path) -> None:
    done = harness("chain", run)
    assert "sealed to the depot" in done.stdout
    export = json.loads((run / "agents/1.chain.json").read_text())
    assert max(len(base64.b64decode(block["event_data"])) for block in export["chain"]) <= 1024


def test_import_includes_the_public_keys_of_its_flight(home: Path, tmp_path: Path) -> None:
    others = {**json.loads((home / "public.json").read_text()), "mission": "00" * 16}
    (home / "others.json").write_text(json.dumps(others))
    (home / "broken.json").write_text(json.dumps({**others, "mission": "no"}))
    done = harness("import", home, "--out", tmp_path / "brought in")
    assert done.returncode == 0, done.stderr
    assert "others.json: public keys of another mission, which sign no block here" in done.stderr
    assert "broken.json: public keys, but `mission` must be" in done.stderr
    assert "left out" not in done.stdout
    judgement = genuine(tmp_path / "brought in", "--keys", home)
    assert judgement["verdict"] == "holds", judgement
    assert "was signed by the agent that it names" in judgement["reason"]
