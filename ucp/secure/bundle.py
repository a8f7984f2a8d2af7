"""The keys of a mission: the public keys, the bundle of each vehicle, and the key set on the ground.

The authority (Ed25519) signs revocations for the operator of the swarm. Each vehicle (Ed25519) signs its own datagrams
and blocks. All vehicles share the group secret of an epoch, from which the keys of datagrams are derived. Event data is
sealed to the public key of the depot (X25519). No vehicle has the private keys of the authority or the depot.

`public.json` (schema `ucp-keys/1`) holds no secret. `7.bundle.json` (schema `ucp-bundle/1`), the bundle of vehicle 7,
holds the secrets of this vehicle. A bundle that other users can read is rejected.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand

from ucp.block import MAX_AGENT_ID
from ucp.secure.keyfile import KeyFileError, key_in, read_key_file, write_key_file

KEY_BYTES = 32
MISSION_ID_BYTES = 16
DEFAULT_EPOCH_S = 600.0
MAX_EPOCH_S = 31 * 86400.0
"""Maximum length of an epoch, 31 days. No mission is longer."""
LAST_EPOCH = 2**32 - 1
LAST_START_US = 2**63

PUBLIC_SCHEMA = "ucp-keys/1"
BUNDLE_SCHEMA = "ucp-bundle/1"
PUBLIC_NAME = "public.json"


@dataclass(frozen=True)
class PublicKeys:
    """The public part of a mission's keys: the mission's ID, and the public keys of authority, depot and all vehicles.

    `depot` is None if event data is not sealed. Epoch e begins `epoch_s` * e mission seconds after the start.
    """

    mission: bytes
    authority: bytes
    depot: bytes | None
    vehicles: Mapping[int, bytes]
    epoch_s: float = DEFAULT_EPOCH_S

    @property
    def fingerprint(self) -> str:
        """The SHA-256 of all public keys of the mission, in hexadecimal. Different keys have different fingerprints."""
        text = json.dumps(self.to_json(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(b"UCP public keys\0" + text.encode("ascii")).hexdigest()

    def to_json(self) -> dict[str, object]:
        """Return the content of `public.json`."""
        return {
            "schema": PUBLIC_SCHEMA,
            "mission": self.mission.hex(),
            "authority": self.authority.hex(),
            "depot": None if self.depot is None else self.depot.hex(),
            "vehicles": {str(agent_id): key.hex() for agent_id, key in sorted(self.vehicles.items())},
            "epoch_s": self.epoch_s,
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """Parse the content of `public.json`. Raises KeyFileError. The error message does not contain the name of the
        file.
        """
        depot = None if document.get("depot") is None else key_in(document, "depot", KEY_BYTES)
        if depot is not None and not _can_seal_to(depot):
            raise KeyFileError("`depot` is not a usable X25519 public key")
        epoch_s = document.get("epoch_s")
        if not isinstance(epoch_s, int | float) or isinstance(epoch_s, bool) or not 1 <= epoch_s <= MAX_EPOCH_S:
            raise KeyFileError(f"`epoch_s` must be a number of seconds 1..{MAX_EPOCH_S:.0f}")
        return cls(
            key_in(document, "mission", MISSION_ID_BYTES),
            key_in(document, "authority", KEY_BYTES),
            depot,
            _parse_vehicles(document.get("vehicles")),
            float(epoch_s),
        )


@dataclass(frozen=True)
class Bundle:
    """The keys of one vehicle: the public keys, its private key, and the group secret of epoch `epoch`.

    `started_us` is the time at which the last incarnation with this bundle started, in microseconds since the Unix
    epoch (UTC). It is None if no agent has used the bundle.
    """

    public: PublicKeys
    agent_id: int
    private_key: bytes = field(repr=False)
    group_secret: bytes = field(repr=False)
    epoch: int = 0
    started_us: int | None = None

    def at_epoch(self, epoch: int, group_secret: bytes) -> "Bundle":
        """Return the bundle of the same vehicle for a later epoch with this group secret."""
        return replace(self, epoch=epoch, group_secret=group_secret)

    def used(self) -> "Bundle":
        """Return a copy of the bundle that is marked as used: the vehicle may have flown with it before."""
        return replace(self, started_us=self.started_us or 0)

    def to_json(self) -> dict[str, object]:
        """Return the content of the bundle file, including the secrets."""
        return {
            **self.public.to_json(),
            "schema": BUNDLE_SCHEMA,
            "agent_id": self.agent_id,
            "private_key": self.private_key.hex(),
            "group_secret": self.group_secret.hex(),
            "epoch": self.epoch,
            **({} if self.started_us is None else {"started_us": self.started_us}),
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """Parse the content of a key bundle's file. Raises KeyFileError. The error message does not contain the name of
        the file.
        """
        public = PublicKeys.from_json(document)
        agent_id, epoch = document.get("agent_id"), document.get("epoch")
        if type(agent_id) is not int or agent_id not in public.vehicles:
            raise KeyFileError("`agent_id` must be one of `vehicles`")
        if type(epoch) is not int or not 0 <= epoch <= LAST_EPOCH:
            raise KeyFileError(f"`epoch` must be a whole number 0..{LAST_EPOCH}")
        started_us = document.get("started_us")
        if started_us is not None and (type(started_us) is not int or not 0 <= started_us < LAST_START_US):
            raise KeyFileError("`started_us` must be a time in microseconds")
        private_key = key_in(document, "private_key", KEY_BYTES)
        if public_key_of(private_key) != public.vehicles[agent_id]:
            raise KeyFileError(f"`private_key` is not that of vehicle {agent_id}")
        return cls(public, agent_id, private_key, key_in(document, "group_secret", KEY_BYTES), epoch, started_us)


@dataclass(frozen=True)
class KeySet:
    """All keys of a mission, including the private keys. The set stays on the ground. `group_secret` belongs to epoch
    0.
    """

    public: PublicKeys
    authority: bytes = field(repr=False)
    depot: bytes | None = field(repr=False)
    vehicles: Mapping[int, bytes] = field(repr=False)
    group_secret: bytes = field(repr=False)

    @classmethod
    def derived(
        cls, seed: bytes, roster: Iterable[int], *, seals: bool = False, epoch_s: float = DEFAULT_EPOCH_S
    ) -> Self:
        """Return the key set derived from a seed. Equal seeds give equal keys.

        For new keys, `seed` must be 32 bytes of `os.urandom`. If `seals` is true, the set has a depot key.
        """

        def derive(name: str, length: int = KEY_BYTES) -> bytes:
            return HKDFExpand(SHA256(), length, b"UCP key set\0" + name.encode("ascii")).derive(seed)

        authority, depot = derive("authority"), derive("depot") if seals else None
        vehicles = {agent_id: derive(f"vehicle {agent_id}") for agent_id in roster}
        public = PublicKeys(
            derive("mission", MISSION_ID_BYTES),
            public_key_of(authority),
            None if depot is None else X25519PrivateKey.from_private_bytes(depot).public_key().public_bytes_raw(),
            {agent_id: public_key_of(key) for agent_id, key in vehicles.items()},
            epoch_s,
        )
        return cls(public, authority, depot, vehicles, derive("group secret"))

    def bundle(self, agent_id: int) -> Bundle:
        """Return the bundle of a vehicle. Raises KeyError if it is not on the roster."""
        return Bundle(self.public, agent_id, self.vehicles[agent_id], self.group_secret)


def bundle_name(agent_id: int) -> str:
    """Return the name of the bundle file of a vehicle."""
    return f"{agent_id}.bundle.json"


def load_bundle(path: Path) -> Bundle:
    """Read a bundle from a file. Raises KeyFileError, for example if other users can read the file."""
    return read_key_file(path, BUNDLE_SCHEMA, Bundle.from_json, secret=True)


def write_bundle(path: Path, bundle: Bundle) -> None:
    """Write a bundle to a file of mode 0600, and replace an older file. Raises OSError."""
    write_key_file(path, bundle.to_json(), secret=True)


def load_public(path: Path) -> PublicKeys:
    """Read public keys from a file. Raises KeyFileError."""
    return read_key_file(path, PUBLIC_SCHEMA, PublicKeys.from_json, secret=False)


def write_public(path: Path, public: PublicKeys) -> None:
    """Write public keys to a file. Raises OSError."""
    write_key_file(path, public.to_json(), secret=False)


def public_key_of(private_key: bytes) -> bytes:
    """Return the Ed25519 public key of a private key."""
    return Ed25519PrivateKey.from_private_bytes(private_key).public_key().public_bytes_raw()


def _parse_vehicles(document: Any) -> dict[int, bytes]:
    if not isinstance(document, dict) or not 1 <= len(document) <= MAX_AGENT_ID:
        raise KeyFileError("`vehicles` must be an object with the public key of each vehicle")
    vehicles = {}
    for name in document:
        agent_id = int(name) if name.isascii() and name.isdecimal() and len(name) <= len(str(MAX_AGENT_ID)) else 0
        if not 1 <= agent_id <= MAX_AGENT_ID or str(agent_id) != name:
            raise KeyFileError(f"`vehicles` must name vehicles by their IDs 1..{MAX_AGENT_ID}")
        vehicles[agent_id] = key_in(document, name, KEY_BYTES, "vehicles.")
    return vehicles


def _can_seal_to(depot: bytes) -> bool:
    """Return whether event data can be sealed to this public key.

    This is not possible for points of low order (RFC 7748, Section 6.1).
    """
    try:
        X25519PrivateKey.from_private_bytes(bytes(KEY_BYTES)).exchange(X25519PublicKey.from_public_bytes(depot))
    except ValueError:
        return False
    return True
