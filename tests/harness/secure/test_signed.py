"""Characteristic 4 by signatures: the maker's trace is not needed, and what was forged or edited is found."""

import base64
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.harness.command import harness
from ucp.block import Block, next_chain_hash

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
    """What came home: exports of agents 1 and 2, no traces, no record; and the mission's public keys."""
    for name in ("1.chain.json", "2.chain.json"):
        shutil.copy(run / "agents" / name, tmp_path)
    shutil.copy(run / "public.json", tmp_path)
    return tmp_path


def genuine(home: Path) -> dict[str, Any]:
    done = harness("check", home, "--json")
    verdict: dict[str, Any] = json.loads(done.stdout)["characteristics"]["4"]
    return verdict


def edited(home: Path, edit: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """The verdict when a block of agent 3 in agent 1's export is edited, and all hashes are made to fit again."""
    path = home / "1.chain.json"
    export = json.loads(path.read_text())
    edit(next(block for block in export["chain"] if block["agent_id"] == 3))
    below = bytes.fromhex(export["inception"]["chain_hash"])
    for block in export["chain"]:
        made = Block(block["agent_id"], block["timestamp_us"], base64.b64decode(block["event_data"]))
        below = next_chain_hash(below, made.block_hash)
        block |= {"block_hash": made.block_hash.hex(), "chain_hash": below.hex()}
    path.write_text(json.dumps(export))
    return genuine(home)


def test_signatures_decide_without_the_makers_trace(home: Path) -> None:
    judgement = genuine(home)
    assert judgement["verdict"] == "holds", judgement
    assert "was signed by the agent that it names" in judgement["reason"]


def test_without_public_keys_nobody_knows(home: Path) -> None:
    (home / "public.json").unlink()
    assert genuine(home)["verdict"] == "not applicable"


def test_signatures_that_were_not_checked_are_not_passed_over(run: Path, tmp_path: Path) -> None:
    whole = shutil.copytree(run, tmp_path / "whole")
    (whole / "public.json").unlink()
    judgement = genuine(whole)
    assert judgement["verdict"] == "holds", "by the makers' own records"
    assert "signatures were not checked" in judgement["reason"]
    done = harness("check", whole)
    assert done.returncode == 2
    assert "public.json is missing, although the run was secured" in done.stderr
    assert "signatures were not checked" not in genuine(run)["reason"]


def test_public_keys_that_are_damaged_are_told(home: Path) -> None:
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
def test_an_edited_export_is_found(home: Path, edit: Callable[[dict[str, Any]], Any], sentence: str) -> None:
    judgement = edited(home, edit)
    assert judgement["verdict"] == "violated"
    assert any(sentence in finding["detail"] for finding in judgement["evidence"]), judgement


def test_a_sealed_run_has_no_event_in_its_blocks(run: Path) -> None:
    done = harness("chain", run)
    assert "sealed to the depot" in done.stdout
    export = json.loads((run / "agents/1.chain.json").read_text())
    assert max(len(base64.b64decode(block["event_data"])) for block in export["chain"]) <= 1024


def test_an_import_takes_the_public_keys_of_its_flight_along(home: Path, tmp_path: Path) -> None:
    others = {**json.loads((home / "public.json").read_text()), "mission": "00" * 16}
    (home / "others.json").write_text(json.dumps(others))
    (home / "broken.json").write_text(json.dumps({**others, "mission": "no"}))
    done = harness("import", home, "--out", tmp_path / "brought in")
    assert done.returncode == 0, done.stderr
    assert "others.json: public keys of another mission, which sign no block here" in done.stderr
    assert "broken.json: public keys, but `mission` must be" in done.stderr
    assert "left out" not in done.stdout
    judgement = genuine(tmp_path / "brought in")
    assert judgement["verdict"] == "holds", judgement
    assert "was signed by the agent that it names" in judgement["reason"]
