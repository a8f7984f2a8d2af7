"""Test key files: written files are read back, wrong files are rejected, and no error message shows a secret."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from ucp.secure.block_signature import block_claim, sign_block
from ucp.secure.bundle import KeySet, load_bundle, load_public, write_bundle, write_public
from ucp.secure.crypto_suite import verify
from ucp.secure.keyfile import MAX_FILE_BYTES, KeyFileError
from ucp.secure.revocation import Revocation, RevocationError

KEYS = KeySet.derived(b"a seed".ljust(32), (1, 7, 28), seals=True)
BUNDLE = KEYS.bundle(7)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "7.bundle.json"
    write_bundle(path, BUNDLE)
    return path


def test_written_bundle_is_read_back_and_only_its_owner_can_read_it(path: Path) -> None:
    assert load_bundle(path) == BUNDLE
    assert path.stat().st_mode & 0o777 == 0o600
    later = BUNDLE.at_epoch(3, bytes(32))
    write_bundle(path, later)
    assert load_bundle(path) == later
    assert [*path.parent.iterdir()] == [path]


def test_written_public_keys_are_read_back(tmp_path: Path) -> None:
    for public in (KEYS.public, replace(KEYS.public, depot=None, epoch_s=30.5)):
        write_public(tmp_path / "public.json", public)
        assert load_public(tmp_path / "public.json") == public


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o601])
def test_bundle_that_other_users_can_read_is_rejected(path: Path, mode: int) -> None:
    path.chmod(mode)
    with pytest.raises(KeyFileError, match="chmod 600"):
        load_bundle(path)


def test_equal_seeds_give_equal_keys_and_different_seeds_share_none() -> None:
    assert KeySet.derived(b"a seed".ljust(32), (1, 7, 28), seals=True) == KEYS
    other = KeySet.derived(b"another".ljust(32), (1, 7, 28), seals=True)
    every = [key for keys in (KEYS, other) for key in (*secrets_of(keys), *keys.public.vehicles.values())]
    assert len({*every}) == len(every)


def secrets_of(keys: KeySet) -> list[bytes]:
    assert keys.depot is not None
    return [keys.authority, keys.depot, keys.group_secret, *keys.vehicles.values()]


def test_repr_of_keys_contains_no_secret() -> None:
    shown = repr(KEYS) + repr(BUNDLE)
    for secret in secrets_of(KEYS):
        assert secret.hex() not in shown
        assert repr(secret)[2:-1] not in shown


WRONG: list[tuple[str, Any, str]] = [
    ("schema", "ucp-bundle/2", "schema ucp-bundle/1"),
    ("mission", "00", "`mission` must be 32 hexadecimal digits"),
    ("authority", 7, "`authority` must be 64 hexadecimal digits"),
    ("depot", "00" * 32, "not a usable X25519 public key"),
    ("depot", "é" * 64, "`depot` must be 64"),
    ("private_key", KEYS.vehicles[1].hex(), "not that of vehicle 7"),
    ("private_key", f" {KEYS.vehicles[7].hex()[:-2]} ", "`private_key` must be 64"),
    ("group_secret", None, "`group_secret` must be 64"),
    ("agent_id", 8, "`agent_id` must be one of `vehicles`"),
    ("agent_id", True, "`agent_id` must be one of `vehicles`"),
    ("epoch", -1, "`epoch` must be a whole number"),
    ("epoch", 10**50, "`epoch` must be a whole number"),
    ("epoch_s", float("nan"), "`epoch_s` must be a number"),
    ("epoch_s", True, "`epoch_s` must be a number"),
    ("vehicles", {}, "`vehicles` must be an object"),
    ("vehicles", {"7": BUNDLE.public.vehicles[7].hex(), "07": "00" * 32}, "by their IDs"),
    ("vehicles", {"7": BUNDLE.public.vehicles[7].hex(), "65536": "00" * 32}, "by their IDs"),
    ("vehicles", {"7": "zz" * 32}, "`vehicles.7` must be 64"),
]


@pytest.mark.parametrize(("key", "value", "sentence"), WRONG)
def test_error_for_a_wrong_value_names_it_without_a_secret(path: Path, key: str, value: Any, sentence: str) -> None:
    path.write_text(json.dumps({**BUNDLE.to_json(), key: value}))
    with pytest.raises(KeyFileError, match=sentence) as refused:
        load_bundle(path)
    assert str(refused.value).startswith(f"{path}: ")
    for secret in secrets_of(KEYS):
        assert secret.hex() not in str(refused.value)
        assert refused.value.__cause__ is None


@pytest.mark.parametrize("content", [b"", b"\xff", b"[" * 100_000, b"[]", b"7" * 5000, bytes(MAX_FILE_BYTES + 1)])
def test_file_that_is_not_a_bundle_is_rejected(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(KeyFileError):
        load_bundle(path)


def test_path_that_is_not_a_regular_file_is_rejected(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo, 0o600)
    for path in (tmp_path, tmp_path / "none", fifo, Path("a\0b")):
        with pytest.raises(KeyFileError):
            load_bundle(path)


def test_block_signature_is_valid_only_for_its_maker_and_mission() -> None:
    maker = Ed25519PrivateKey.from_private_bytes(BUNDLE.private_key)
    mission, public = KEYS.public.mission, KEYS.public.vehicles
    signature = sign_block(maker, mission, b"BD")
    assert verify(block_claim(public[7], mission, b"BD", signature))
    assert not verify(block_claim(public[1], mission, b"BD", signature))
    assert not verify(block_claim(public[7], bytes(16), b"BD", signature))
    assert not verify(block_claim(public[7], mission, b"BE", signature))
    assert not verify(block_claim(public[7], mission, b"BD", signature[:-1]))
    assert not verify(block_claim(b"short", mission, b"BD", signature))


def test_revocation_is_valid_only_if_the_authority_signed_it() -> None:
    mission, authority = KEYS.public.mission, KEYS.public.authority
    revocation = Revocation.signed(Ed25519PrivateKey.from_private_bytes(KEYS.authority), mission, 2, {28, 1})
    body = revocation.encode()
    assert Revocation.decode(body, authority, mission) == revocation
    for position in range(len(body)):
        forged = bytearray(body)
        forged[position] ^= 1
        with pytest.raises(RevocationError):
            Revocation.decode(bytes(forged), authority, mission)
        with pytest.raises(RevocationError):
            Revocation.decode(body[:position], authority, mission)
    for wrong in (body + b"\0", b""):
        with pytest.raises(RevocationError):
            Revocation.decode(wrong, authority, mission)
    with pytest.raises(RevocationError):
        Revocation.decode(body, KEYS.public.vehicles[7], mission)
    with pytest.raises(RevocationError):
        Revocation.decode(body, authority, bytes(16))
