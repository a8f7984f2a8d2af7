"""Test how a run excludes vehicles: with the authority's key, or with a message that the authority signed before."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from harness.errors import ScenarioError
from harness.play.keyring.key_directory import KeyDirectory, write_revocation
from harness.run.simulate import simulate
from harness.scenario import Scenario
from tests.harness.command import harness
from tests.harness.secure.secrets import leaks, left_in, secrets
from tests.harness.virtual import scenario

ROSTER = [1, 2, 3]
REVOKED = {"timeline": [{"at_s": 60, "kill": [3]}, {"at_s": 70, "revoke": [3], "heard_by": [1]}]}


@pytest.fixture
def home(tmp_path: Path) -> KeyDirectory:
    home = KeyDirectory.new(tmp_path / "home", ROSTER, seals=True, epoch_s=600.0)
    home.write_bundles(tmp_path / "bundles")
    return home


def asked(directory: Path, **keys: Any) -> Scenario:
    return scenario(agents=ROSTER, duration_s=200, security={"keys": str(directory)}, **{**REVOKED, **keys})


def test_revocation_by_a_run_does_not_change_the_key_directory(home: KeyDirectory, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in home.directory.iterdir()}
    path = tmp_path / "asked.yaml"
    path.write_text(json.dumps(asked(home.directory).model_dump(mode="json", exclude_defaults=True)))
    done = harness("run", path, "--backend", "sim", "--seed", "1", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stdout + done.stderr
    told_by = [
        agent_id
        for agent_id in ROSTER
        if '"command":"revoke"' in (tmp_path / f"run/agents/{agent_id}.trace.jsonl").read_text().replace(" ", "")
    ]
    assert told_by == [1, 2]
    assert {path.name: path.read_bytes() for path in home.directory.iterdir()} == before
    assert leaks(secrets(home, 2), left_in(tmp_path / "run")) == []


def test_bundles_revoke_by_the_message_that_was_made_at_home(home: KeyDirectory, tmp_path: Path) -> None:
    done = harness("keys", "revoke", home.directory, "3", "--out", tmp_path / "bundles/revocation.json")
    assert done.returncode == 0, done.stderr
    played = simulate(asked(tmp_path / "bundles"), 1)
    assert played.result.chains == simulate(asked(home.directory), 1).result.chains


Break = Callable[[KeyDirectory, Path], None]
MISTAKES: list[tuple[Break, dict[str, Any], str]] = [
    (lambda home, bundles: None, {}, "needs the authority's key or a revocation, and the directory has neither"),
    (
        lambda home, bundles: write_revocation(bundles / "revocation.json", home.revoke([2]), home.public()),
        {},
        "to revoke agent 3 needs the authority's key.* revokes only agent 2",
    ),
    (
        lambda home, bundles: write_revocation(bundles / "revocation.json", home.revoke([2, 3]), home.public()),
        {},
        "revocation.json revokes agent 2 before the mission",
    ),
    (
        lambda home, bundles: write_revocation(bundles / "revocation.json", home.revoke([3]), home.public()),
        {"timeline": []},
        "revocation.json revokes agent 3 before the mission",
    ),
    (
        lambda home, bundles: (bundles / "revocation.json").write_text("{"),
        {"timeline": []},
        "revocation.json: not JSON",
    ),
    (
        lambda home, bundles: other(home, bundles).write_bundles(bundles, [2], overwrite=True) and None,
        {"timeline": []},
        "belong to several missions",
    ),
]


def other(home: KeyDirectory, bundles: Path) -> KeyDirectory:
    return KeyDirectory.new(bundles / "other", ROSTER, seals=True, epoch_s=600.0)


@pytest.mark.parametrize(("mistake", "keys", "sentence"), MISTAKES)
def test_revocation_without_a_key_is_refused(
    home: KeyDirectory, tmp_path: Path, mistake: Break, keys: dict[str, Any], sentence: str
) -> None:
    mistake(home, tmp_path / "bundles")
    with pytest.raises(ScenarioError, match=sentence):
        simulate(asked(tmp_path / "bundles", **keys), 1)


def test_timeline_must_begin_with_the_prepared_revocation(home: KeyDirectory) -> None:
    assert home.revoke([3]).number == 1
    assert not simulate(asked(home.directory), 1).result.bad
    later = [{"at_s": 60, "revoke": [2], "heard_by": [1]}, *REVOKED["timeline"][1:]]
    with pytest.raises(ScenarioError, match="revokes agent 3 before the mission"):
        simulate(asked(home.directory, timeline=later), 1)


def test_run_refuses_keys_with_another_fingerprint(home: KeyDirectory) -> None:
    def with_fingerprint(fingerprint: str) -> Scenario:
        security = {"keys": str(home.directory), "fingerprint": fingerprint}
        return scenario(agents=ROSTER, duration_s=10, security=security)

    assert not simulate(with_fingerprint(home.public().fingerprint), 1).result.bad
    assert home.public().fingerprint in harness("keys", "inspect", home.directory).stdout
    with pytest.raises(ScenarioError, match=f"other public keys, with the fingerprint {home.public().fingerprint}"):
        simulate(with_fingerprint("00" * 32), 1)
