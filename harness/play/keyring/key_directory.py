"""Read and write the directory with the keys of a mission, and sign messages that revoke the keys of vehicles.

The keys of the authority and of the depot never leave the directory. They are separate files, because the person who
opens sealed events does not need the right to revoke keys. Other users can neither enter the directory nor read the
secret files.
"""

import base64
import binascii
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from harness.errors import HarnessError, MachineError
from ucp.secure.bundle import (
    KEY_BYTES,
    MISSION_ID_BYTES,
    PUBLIC_NAME,
    Bundle,
    KeySet,
    PublicKeys,
    bundle_name,
    load_public,
    public_key_of,
    write_bundle,
    write_public,
)
from ucp.secure.keyfile import KeyFileError, key_in, read_key_file, write_key_file
from ucp.secure.revocation import LAST_NUMBER, MAX_REVOKED, Revocation, RevocationError
from ucp.secure.sealing import Depot

AUTHORITY_NAME, DEPOT_NAME, VEHICLES_NAME = "authority.key", "depot.key", "vehicles.key"
AUTHORITY_SCHEMA, DEPOT_SCHEMA, VEHICLES_SCHEMA = "ucp-authority-key/1", "ucp-depot-key/1", "ucp-vehicle-keys/1"
REVOCATION_NAME, REVOCATION_SCHEMA = "revocation.json", "ucp-revocation/1"
HOME_MODE = 0o700
MOST_NAMED = 20

T = TypeVar("T")


class KeysError(HarnessError):
    """An error: keys cannot be used, or must not be created."""


@dataclass(frozen=True)
class KeyDirectory:
    """A directory with the keys of a mission. Methods that read raise KeysError, and methods that write raise
    MachineError.
    """

    directory: Path

    @classmethod
    def new(cls, directory: Path, roster: Iterable[int], *, seals: bool, epoch_s: float) -> "KeyDirectory":
        """Create keys in a new directory. If `seals` is true, also create a key pair for encrypted event data."""
        keys = KeySet.derived(os.urandom(KEY_BYTES), roster, seals=seals, epoch_s=epoch_s)
        home, mission = cls(directory), keys.public.mission.hex()
        if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
            raise KeysError(f"{directory} is not an empty directory: choose a new one, because keys are never replaced")
        secret: dict[str, dict[str, Any]] = {
            AUTHORITY_NAME: {"schema": AUTHORITY_SCHEMA, "mission": mission, "private_key": keys.authority.hex()},
            VEHICLES_NAME: {
                "schema": VEHICLES_SCHEMA,
                "mission": mission,
                "group_secret": keys.group_secret.hex(),
                "vehicles": {str(agent_id): key.hex() for agent_id, key in keys.vehicles.items()},
            },
        }
        if keys.depot is not None:
            secret[DEPOT_NAME] = {"schema": DEPOT_SCHEMA, "mission": mission, "private_key": keys.depot.hex()}
        try:
            directory.mkdir(mode=HOME_MODE, parents=True, exist_ok=True)
            directory.chmod(HOME_MODE)
            for name, document in secret.items():
                write_key_file(directory / name, document, secret=True)
            write_public(directory / PUBLIC_NAME, keys.public)
        except OSError as error:
            raise _write_error(directory, error) from None
        return home

    def public(self) -> PublicKeys:
        """Return the public keys of the mission."""
        return _as_keys_error(lambda: load_public(self.directory / PUBLIC_NAME))

    def bundle(self, agent_id: int) -> Bundle:
        """Return the secret keys of a vehicle. Raises KeysError if the vehicle is revoked."""
        return self.bundles([agent_id])[agent_id]

    def bundles(self, agents: Sequence[int] | None = None, *, also_revoked: bool = False) -> dict[int, Bundle]:
        """Return the secret keys of these vehicles. Without `agents`, return the keys of all vehicles that are not
        revoked.
        """
        public, path = self.public(), self.directory / VEHICLES_NAME
        revocation = None if also_revoked else self.revocation()
        revoked = revocation.revoked if revocation else frozenset[int]()
        wanted = sorted({*public.vehicles} - revoked) if agents is None else agents
        for agent_id in wanted:
            if agent_id not in public.vehicles:
                raise _unknown_agent(agent_id, public)
            if agent_id in revoked:
                raise KeysError(f"agent {agent_id} is revoked: use another vehicle, or make new keys")

        def parse(document: dict[str, Any]) -> dict[int, Bundle]:
            _check_mission(document, public)
            group_secret = key_in(document, "group_secret", KEY_BYTES)
            private = document.get("vehicles")
            if not isinstance(private, dict):
                raise KeyFileError("`vehicles` must be an object with the key of each vehicle")
            bundles = {}
            for agent_id in wanted:
                key = key_in(private, str(agent_id), KEY_BYTES, "vehicles.")
                if public_key_of(key) != public.vehicles[agent_id]:
                    raise KeyFileError(f"the key of vehicle {agent_id} does not match {PUBLIC_NAME}")
                bundles[agent_id] = Bundle(public, agent_id, key, group_secret)
            return bundles

        return _as_keys_error(lambda: read_key_file(path, VEHICLES_SCHEMA, parse, secret=True))

    def write_bundles(
        self, directory: Path, agents: Sequence[int] | None = None, *, overwrite: bool = False
    ) -> list[Path]:
        """Write a key file for each vehicle. Only the user who owns the files can read them. Return their paths."""
        bundles = self.bundles(agents)
        paths = {agent_id: directory / bundle_name(agent_id) for agent_id in bundles}
        for path in paths.values():
            if path.exists() and not overwrite:
                raise KeysError(f"{path} exists, and may be of a later epoch: add --overwrite to replace it")
        try:
            directory.mkdir(mode=HOME_MODE, parents=True, exist_ok=True)
            for agent_id, path in paths.items():
                write_bundle(path, bundles[agent_id].used() if path.exists() else bundles[agent_id])
        except OSError as error:
            raise _write_error(directory, error) from None
        return [*paths.values()]

    def revocation(self, public: PublicKeys | None = None) -> Revocation | None:
        """Read the newest list of revoked vehicles from the directory, and check its signature.

        Return None if the directory has no list.
        """
        path = self.directory / REVOCATION_NAME
        return load_revocation(path, public or self.public()) if path.exists() else None

    def revoke(self, agents: Sequence[int]) -> Revocation:
        """Revoke these vehicles. Return a signed list with the next number. The list contains all vehicles revoked so
        far.
        """
        public, last = self.public(), self.revocation()
        before = last.revoked if last else frozenset[int]()
        revoked = before.union(agents)
        unknown = sorted(revoked - {*public.vehicles})
        if unknown:
            raise _unknown_agent(unknown[0], public)
        if revoked == before:
            raise KeysError(f"{listed(agents)}: already revoked in {self.directory / REVOCATION_NAME}")
        number = last.number + 1 if last else 1
        if len(revoked) > MAX_REVOKED or number > LAST_NUMBER:
            raise KeysError(f"a revocation has room for {MAX_REVOKED} vehicles: make new keys for the other vehicles")
        authority = Ed25519PrivateKey.from_private_bytes(self.authority(public))
        revocation = Revocation.signed(authority, public.mission, number, revoked)
        try:
            write_revocation(self.directory / REVOCATION_NAME, revocation, public)
        except OSError as error:
            raise _write_error(self.directory, error) from None
        return revocation

    def authority(self, public: PublicKeys) -> bytes:
        """Return the private key that signs lists of revoked vehicles. Raises KeysError if the key does not match
        `public`.
        """

        def parse(document: dict[str, Any]) -> bytes:
            key = key_in(document, "private_key", KEY_BYTES)
            if public_key_of(key) != public.authority:
                raise KeyFileError(f"this key of the authority does not match {PUBLIC_NAME}")
            return key

        return _as_keys_error(
            lambda: read_key_file(self.directory / AUTHORITY_NAME, AUTHORITY_SCHEMA, parse, secret=True)
        )


def load_depot_key(path: Path) -> Depot:
    """Read the key that decrypts event data from a key file or a directory of keys. Raises KeysError."""
    file = path / DEPOT_NAME if path.is_dir() else path

    def parse(document: dict[str, Any]) -> Depot:
        return Depot(key_in(document, "mission", MISSION_ID_BYTES), key_in(document, "private_key", KEY_BYTES))

    return _as_keys_error(lambda: read_key_file(file, DEPOT_SCHEMA, parse, secret=True))


def load_revocation(path: Path, public: PublicKeys) -> Revocation:
    """Read a list of revoked vehicles from a file. Raises KeysError if the signature of the list is not valid for this
    mission.
    """

    def parse(document: dict[str, Any]) -> Revocation:
        _check_mission(document, public)
        try:
            body = base64.b64decode(str(document.get("message")), validate=True)
            return Revocation.decode(body, public.authority, public.mission)
        except (binascii.Error, ValueError) as error:
            reason = error if isinstance(error, RevocationError) else "it is not base64"
            raise KeyFileError(f"`message` is not a valid revocation: {reason}") from None

    return _as_keys_error(lambda: read_key_file(path, REVOCATION_SCHEMA, parse, secret=False))


def write_revocation(path: Path, revocation: Revocation, public: PublicKeys) -> None:
    """Write a signed list of revoked vehicles. Raises OSError."""
    message = base64.b64encode(revocation.encode()).decode("ascii")
    document = {"schema": REVOCATION_SCHEMA, "mission": public.mission.hex(), "message": message}
    write_key_file(path, document, secret=False)


def _check_mission(document: Mapping[str, Any], public: PublicKeys) -> None:
    if key_in(document, "mission", MISSION_ID_BYTES) != public.mission:
        raise KeyFileError(f"this file belongs to another mission than {PUBLIC_NAME}")


def _as_keys_error(read: Callable[[], T]) -> T:
    """Call `read` and return its result. Convert a KeyFileError to a KeysError."""
    try:
        return read()
    except KeyFileError as error:
        raise KeysError(str(error)) from None


def _write_error(directory: Path, error: OSError) -> MachineError:
    return MachineError(f"{directory} cannot be written: {error.strerror}; choose another directory")


def _unknown_agent(agent_id: int, public: PublicKeys) -> KeysError:
    return KeysError(f"agent {agent_id} is not in this mission, which has {listed(public.vehicles)}")


def listed(agents: Iterable[int]) -> str:
    """Return the agents as text for a sentence, such as "agents 1 and 2"."""
    first, *others = sorted({*agents})
    shown = ", ".join(map(str, [first, *others[:MOST_NAMED]])) + (", ..." if len(others) > MOST_NAMED else "")
    return f"agents {shown}" if others else f"agent {shown}"


class RevocationAuthority:
    """The authority that revokes vehicles. It signs lists of all vehicles revoked so far. `last` is the newest list.

    Without a `private_key`, the authority can only return `last`. The authority does not store new lists in the key
    directory, because a mission must not change this directory.
    """

    def __init__(self, public: PublicKeys, private_key: bytes | None, last: Revocation | None = None) -> None:
        self._public = public
        self._private_key = private_key
        self._last = last

    @classmethod
    def of(cls, keys: KeySet) -> "RevocationAuthority":
        """Return the authority that belongs to newly created keys."""
        return cls(keys.public, keys.authority)

    @classmethod
    def in_directory(cls, home: KeyDirectory, public: PublicKeys) -> "RevocationAuthority":
        """Return the authority of a key directory. The private key and the list of revoked vehicles may be missing.

        Raises KeysError.
        """
        private_key = home.authority(public) if (home.directory / AUTHORITY_NAME).exists() else None
        return cls(public, private_key, home.revocation(public))

    @property
    def revoked(self) -> frozenset[int]:
        """The vehicles that are revoked so far."""
        return self._last.revoked if self._last else frozenset()

    def refuse(self, agents: Iterable[int], directory: object) -> None:
        """Raise KeysError if the authority cannot revoke these agents. The message names `directory`."""
        lacking = {*agents} - self.revoked
        if self._private_key is not None or not lacking:
            return
        found = f"{REVOCATION_NAME} revokes only {listed(self.revoked)}" if self._last else "the directory has neither"
        raise KeysError(
            f"to revoke {listed(lacking)} needs the authority's key or a revocation, and {found}: use the directory "
            f"that `ucp-harness keys new` made, or write {directory}/{REVOCATION_NAME} with "
            "`ucp-harness keys revoke --out`"
        )

    def revoke(self, agent_id: int) -> bytes:
        """Return a message body with a signed list of revoked agents that contains this agent. If the newest list
        already contains the agent, use this list. Otherwise sign a new list.
        """
        if self._last is None or agent_id not in self._last.revoked:
            assert self._private_key is not None, "was refused"
            signer = Ed25519PrivateKey.from_private_bytes(self._private_key)
            number = self._last.number + 1 if self._last else 1
            self._last = Revocation.signed(signer, self._public.mission, number, self.revoked | {agent_id})
        return self._last.encode()
