"""The keys of a mission: what everybody may know of them, what one vehicle has, and what stays home.

An authority (Ed25519) speaks for whoever sends the swarm. Each vehicle (Ed25519) signs for itself. All vehicles share
the group secret of an epoch, from which the keys of datagrams are derived. Event data is sealed to the depot (X25519).
The private keys of authority and depot are in no vehicle.

`public.json` (schema `ucp-keys/1`) holds no secret. The bundle of vehicle 7, `7.bundle.json` (schema `ucp-bundle/1`),
holds its own secrets, and is refused if others can read it.
"""

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
"""No mission is longer."""
LAST_EPOCH = 2**32 - 1

PUBLIC_SCHEMA = "ucp-keys/1"
BUNDLE_SCHEMA = "ucp-bundle/1"
PUBLIC_NAME = "public.json"


@dataclass(frozen=True)
class PublicKeys:
    """What everybody may know: the mission's ID, and the public keys of authority, depot and all vehicles.

    `depot` is None where event data is not sealed. Epoch e begins `epoch_s` * e mission seconds after the start.
    """

    mission: bytes
    authority: bytes
    depot: bytes | None
    vehicles: Mapping[int, bytes]
    epoch_s: float = DEFAULT_EPOCH_S

    def to_json(self) -> dict[str, Any]:
        """As `public.json` has it."""
        return {
            "schema": PUBLIC_SCHEMA,
            "mission": self.mission.hex(),
            "authority": self.authority.hex(),
            "depot": None if self.depot is None else self.depot.hex(),
            "vehicles": {str(agent_id): key.hex() for agent_id, key in sorted(self.vehicles.items())},
            "epoch_s": self.epoch_s,
        }

    @classmethod
    def of_json(cls, document: Mapping[str, Any]) -> Self:
        """Raises KeyFileError, without the file's name."""
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
            _vehicles(document.get("vehicles")),
            float(epoch_s),
        )


@dataclass(frozen=True)
class Bundle:
    """All that one vehicle is given: what is public, its private key, and the group secret of an epoch."""

    public: PublicKeys
    agent_id: int
    private_key: bytes = field(repr=False)
    group_secret: bytes = field(repr=False)
    epoch: int = 0

    def at_epoch(self, epoch: int, group_secret: bytes) -> "Bundle":
        """The same vehicle's bundle in a later epoch."""
        return replace(self, epoch=epoch, group_secret=group_secret)

    def to_json(self) -> dict[str, Any]:
        """As the file has it, with all that is secret."""
        return {
            **self.public.to_json(),
            "schema": BUNDLE_SCHEMA,
            "agent_id": self.agent_id,
            "private_key": self.private_key.hex(),
            "group_secret": self.group_secret.hex(),
            "epoch": self.epoch,
        }

    @classmethod
    def of_json(cls, document: Mapping[str, Any]) -> Self:
        """Raises KeyFileError, without the file's name."""
        public = PublicKeys.of_json(document)
        agent_id, epoch = document.get("agent_id"), document.get("epoch")
        if type(agent_id) is not int or agent_id not in public.vehicles:
            raise KeyFileError("`agent_id` must be one of `vehicles`")
        if type(epoch) is not int or not 0 <= epoch <= LAST_EPOCH:
            raise KeyFileError(f"`epoch` must be a whole number 0..{LAST_EPOCH}")
        private_key = key_in(document, "private_key", KEY_BYTES)
        if public_key_of(private_key) != public.vehicles[agent_id]:
            raise KeyFileError(f"`private_key` is not that of vehicle {agent_id}")
        return cls(public, agent_id, private_key, key_in(document, "group_secret", KEY_BYTES), epoch)


@dataclass(frozen=True)
class KeySet:
    """All keys of a mission, as they are at home; `group_secret` is that of epoch 0."""

    public: PublicKeys
    authority: bytes = field(repr=False)
    depot: bytes | None = field(repr=False)
    vehicles: Mapping[int, bytes] = field(repr=False)
    group_secret: bytes = field(repr=False)

    @classmethod
    def derived(
        cls, seed: bytes, roster: Iterable[int], *, seals: bool = False, epoch_s: float = DEFAULT_EPOCH_S
    ) -> Self:
        """The key set that comes of a seed: equal seeds, equal keys. New keys take 32 bytes of `os.urandom`.

        `seals` says whether there is a depot key.
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
        """What this vehicle is given. Raises KeyError if it is not on the roster."""
        return Bundle(self.public, agent_id, self.vehicles[agent_id], self.group_secret)


def bundle_name(agent_id: int) -> str:
    """What the file of a vehicle's bundle is called."""
    return f"{agent_id}.bundle.json"


def load_bundle(path: Path) -> Bundle:
    """The bundle in a file that nobody else can read. Raises KeyFileError."""
    return read_key_file(path, BUNDLE_SCHEMA, Bundle.of_json, secret=True)


def write_bundle(path: Path, bundle: Bundle) -> None:
    """Write it in the place of an older one, with mode 0600. Raises OSError."""
    write_key_file(path, bundle.to_json(), secret=True)


def load_public(path: Path) -> PublicKeys:
    """The public keys in a file. Raises KeyFileError."""
    return read_key_file(path, PUBLIC_SCHEMA, PublicKeys.of_json, secret=False)


def write_public(path: Path, public: PublicKeys) -> None:
    """Raises OSError."""
    write_key_file(path, public.to_json(), secret=False)


def public_key_of(private_key: bytes) -> bytes:
    """The Ed25519 public key that belongs to a private one."""
    return Ed25519PrivateKey.from_private_bytes(private_key).public_key().public_bytes_raw()


def _vehicles(document: Any) -> dict[int, bytes]:
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
    """Whether a secret can be agreed on with this key: with points of low order none can (RFC 7748, Section 6.1)."""
    try:
        X25519PrivateKey.from_private_bytes(bytes(KEY_BYTES)).exchange(X25519PublicKey.from_public_bytes(depot))
    except ValueError:
        return False
    return True
