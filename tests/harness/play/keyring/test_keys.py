"""Test `ucp-harness keys`.

Secrets stay in their directory, a bundle has the keys of one vehicle only, and the output contains no secret.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from harness.play.keyring.key_directory import KeyDirectory, KeysError, load_depot_key
from tests.harness.command import harness
from ucp.secure.bundle import load_bundle, load_public


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create the keys of three vehicles with their bundles, for tests that only read them."""
    home = tmp_path_factory.mktemp("keys") / "home"
    KeyDirectory.new(home, [1, 7, 28], seals=True, epoch_s=60.0).write_bundles(home.parent / "bundles")
    return home


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return KeyDirectory.new(tmp_path / "home", [1, 7, 28], seals=True, epoch_s=60.0).directory


def secrets(home: Path) -> list[str]:
    """Return the secrets in all files of a directory."""
    private = json.loads((home / "vehicles.key").read_text())
    keys = [json.loads((home / name).read_text())["private_key"] for name in ("authority.key", "depot.key")]
    return [*keys, private["group_secret"], *private["vehicles"].values()]


def test_other_users_cannot_read_secret_files(made: Path) -> None:
    assert made.stat().st_mode & 0o777 == 0o700
    modes = {path.name: path.stat().st_mode & 0o777 for path in (*made.iterdir(), *(made.parent / "bundles").iterdir())}
    assert modes.pop("public.json") == 0o644
    assert {*modes} == {f"{n}.bundle.json" for n in (1, 7, 28)} | {"authority.key", "depot.key", "vehicles.key"}
    assert {*modes.values()} == {0o600}


def test_bundle_has_the_secrets_of_one_vehicle(made: Path) -> None:
    text = (made.parent / "bundles/7.bundle.json").read_text()
    authority, depot, group_secret, first, seventh, last = secrets(made)
    assert group_secret in text and seventh in text
    assert not any(secret in text for secret in (authority, depot, first, last))
    bundle = load_bundle(made.parent / "bundles/7.bundle.json")
    assert bundle.public == load_public(made / "public.json")
    assert bundle.public.epoch_s == 60.0


@pytest.mark.parametrize("how", [(), ("--json",)])
def test_inspect_reveals_no_secret(made: Path, how: tuple[str, ...]) -> None:
    done = harness("keys", "inspect", made, made.parent / "bundles", *how)
    assert done.returncode == 0
    assert "the bundle of vehicle 28" in done.stdout
    assert not any(secret in done.stdout + done.stderr for secret in secrets(made))


def test_keys_of_another_mission_are_refused(made: Path, home: Path) -> None:
    done = harness("keys", "inspect", made / "public.json", home / "public.json")
    assert (done.returncode, "belong to 2 missions" in done.stderr) == (1, True)


def test_revocation_lists_all_vehicles_revoked_so_far(home: Path) -> None:
    assert harness("keys", "revoke", home, "7").returncode == 0
    done = harness("keys", "revoke", home, "1", "--out", home.parent / "message.json")
    assert done.stdout.rstrip().endswith("number 2, revoked 1, 7")
    assert (home.parent / "message.json").read_text() == (home / "revocation.json").read_text()
    assert [path.name for path in KeyDirectory(home).write_bundles(home.parent / "left")] == ["28.bundle.json"]
    for wrong, sentence in ((7, "already revoked"), (9, "not in this mission, which has agents 1, 7, 28")):
        done = harness("keys", "revoke", home, str(wrong))
        assert (done.returncode, sentence in done.stderr) == (2, True)
    with pytest.raises(KeysError, match="agent 7 is revoked"):
        KeyDirectory(home).bundle(7)


def test_existing_key_files_are_not_replaced(home: Path) -> None:
    done = harness("keys", "new", home, "--agents", "3")
    assert (done.returncode, "is not an empty directory" in done.stderr) == (2, True)
    for _ in range(2):
        done = harness("keys", "bundle", home, "--out", home.parent / "out", "--agent", "7")
    assert (done.returncode, "--overwrite" in done.stderr) == (2, True)


def edited(path: Path, **keys: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **keys}))


def test_keys_that_do_not_belong_together_are_refused(home: Path, made: Path) -> None:
    (home / "vehicles.key").write_text((made / "vehicles.key").read_text())
    with pytest.raises(KeysError, match="belongs to another mission"):
        KeyDirectory(home).bundle(7)
    edited(home / "vehicles.key", mission=load_public(home / "public.json").mission.hex())
    with pytest.raises(KeysError, match="does not match"):
        KeyDirectory(home).bundle(7)
    (home / "authority.key").write_text((made / "authority.key").read_text())
    with pytest.raises(KeysError, match="key of the authority does not match"):
        KeyDirectory(home).revoke([7])
    (home / "depot.key").chmod(0o640)
    with pytest.raises(KeysError, match="chmod 600"):
        load_depot_key(home)


def test_edited_revocation_revokes_no_vehicle(home: Path) -> None:
    KeyDirectory(home).revoke([7])
    for message in ("AAAA", "no base64", 7, None):
        edited(home / "revocation.json", message=message)
        with pytest.raises(KeysError, match="`message` is"):
            KeyDirectory(home).revocation()
