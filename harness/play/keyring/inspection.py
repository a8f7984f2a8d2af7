"""Describe key files without revealing a secret."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from harness.play.keyring.key_directory import (
    AUTHORITY_SCHEMA,
    DEPOT_SCHEMA,
    REVOCATION_SCHEMA,
    VEHICLES_SCHEMA,
    KeysError,
    load_revocation,
)
from ucp.secure.bundle import (
    BUNDLE_SCHEMA,
    KEY_BYTES,
    MISSION_ID_BYTES,
    PUBLIC_NAME,
    PUBLIC_SCHEMA,
    Bundle,
    PublicKeys,
    load_public,
    public_key_of,
)
from ucp.secure.keyfile import KeyFileError, key_in, read_any_key_file

Facts = dict[str, Any]
"""The facts about a key file as JSON. The facts are `file`, `kind` and `mission`, and further keys for some kinds of
files.
"""


def inspect(path: Path) -> list[Facts]:
    """Return the facts about a key file, or about each file in a directory. Raises KeysError for an unusable file."""
    files = [path]
    if path.is_dir():
        candidates = sorted(path.iterdir(), key=lambda file: (len(file.name), file.name))
        files = [file for file in candidates if file.suffix in (".json", ".key")]
        if not files:
            raise KeysError(f"{path} has no key files: make keys with `ucp-harness keys new`, in a new directory")
    return [_inspect(file) for file in files]


def in_words(facts: Facts) -> str:
    """Format the facts about a key file as one line of text. Public keys are shortened."""
    more = [f"{name.replace('_', ' ')} {_shown(name, value)}" for name, value in facts.items() if name not in _HEAD]
    return f"{facts['file']}: {facts['kind']}, mission {facts['mission']}" + "".join(f", {words}" for words in more)


_HEAD = ("file", "kind", "mission")
_DIGITS = 16
_FINGERPRINT = "fingerprint"


def _shown(name: str, value: Any) -> str:
    match value:
        case None:
            return "none"
        case dict():
            return f"{', '.join(value)}" if len(value) <= _DIGITS else f"{len(value)} of them"
        case list():
            return ", ".join(map(str, value))
        case str() if len(value) == 2 * KEY_BYTES and name != _FINGERPRINT:
            return value[:_DIGITS]
    return str(value)


def _inspect(path: Path) -> Facts:
    def private(document: Facts) -> Facts:
        """Return the facts about a private key: the kind of the key, the mission, and the public key of the same key
        pair.
        """
        mission = key_in(document, "mission", MISSION_ID_BYTES).hex()
        private_key = key_in(document, "private_key", KEY_BYTES)
        if document["schema"] == DEPOT_SCHEMA:
            public = X25519PrivateKey.from_private_bytes(private_key).public_key().public_bytes_raw()
            return {"kind": "the depot's key", "mission": mission, "public_key": public.hex()}
        return {"kind": "the authority's key", "mission": mission, "public_key": public_key_of(private_key).hex()}

    def vehicles(document: Facts) -> Facts:
        mission = key_in(document, "mission", MISSION_ID_BYTES).hex()
        named = document.get("vehicles")
        if not isinstance(named, dict):
            raise KeyFileError("`vehicles` must be an object with the key of each vehicle")
        keys = {name: public_key_of(key_in(named, name, KEY_BYTES, "vehicles.")).hex() for name in named}
        return {"kind": "the vehicles' keys", "mission": mission, "vehicles": keys}

    def revocation(document: Facts) -> Facts:
        mission = key_in(document, "mission", MISSION_ID_BYTES).hex()
        public = path.with_name(PUBLIC_NAME)
        if not public.exists():
            return {"kind": "a revocation, not checked because public.json is missing", "mission": mission}
        revocation = load_revocation(path, load_public(public))
        return {
            "kind": "a revocation",
            "mission": mission,
            "number": revocation.number,
            "revoked": sorted(revocation.revoked),
        }

    kinds: dict[str, tuple[bool, Callable[[Facts], Facts]]] = {
        PUBLIC_SCHEMA: (False, lambda document: {"kind": "public keys", **_public(PublicKeys.from_json(document))}),
        BUNDLE_SCHEMA: (True, lambda document: _bundle(Bundle.from_json(document))),
        AUTHORITY_SCHEMA: (True, private),
        DEPOT_SCHEMA: (True, private),
        VEHICLES_SCHEMA: (True, vehicles),
        REVOCATION_SCHEMA: (False, revocation),
    }
    try:
        return {"file": str(path), **read_any_key_file(path, kinds)}
    except KeyFileError as error:
        raise KeysError(str(error)) from None


def _public(public: PublicKeys) -> Facts:
    facts = public.to_json()
    del facts["schema"]
    return {**facts, _FINGERPRINT: public.fingerprint}


def _bundle(bundle: Bundle) -> Facts:
    of_vehicle = {"kind": f"the bundle of vehicle {bundle.agent_id}", "epoch": bundle.epoch}
    return {**of_vehicle, "agent_id": bundle.agent_id, **_public(bundle.public)}
