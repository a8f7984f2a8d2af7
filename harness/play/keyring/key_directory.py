"""The directory of a mission's keys, and the authority that revokes them.

The authority's and the depot's keys never leave it. Each is a file of its own, as whoever opens what was sealed to the
depot need not be able to speak for the authority. Others can neither enter the directory nor read what is secret in it.
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
    """Keys that cannot be used, or must not be made."""


@dataclass(frozen=True)
class Home:
    """A directory of keys. All that reads it raises KeysError, all that writes it MachineError."""

    directory: Path

    @classmethod
    def new(cls, directory: Path, roster: Iterable[int], *, seals: bool, epoch_s: float) -> "Home":
        """New keys in a new directory; with a depot key if it `seals`."""
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
            raise _refused(directory, error) from None
        return home

    def public(self) -> PublicKeys:
        """What everybody may know."""
        return _sound(lambda: load_public(self.directory / PUBLIC_NAME))

    def bundle(self, agent_id: int) -> Bundle:
        """What this vehicle is given, in epoch 0. A revoked one is given nothing."""
        return self.bundles([agent_id])[agent_id]

    def bundles(self, agents: Sequence[int] | None = None, *, also_revoked: bool = False) -> dict[int, Bundle]:
        """What these vehicles are given, or all that are not revoked."""
        public, path = self.public(), self.directory / VEHICLES_NAME
        revocation = None if also_revoked else self.revocation()
        revoked = revocation.revoked if revocation else frozenset[int]()
        wanted = sorted({*public.vehicles} - revoked) if agents is None else agents
        for agent_id in wanted:
            if agent_id not in public.vehicles:
                raise _stranger(agent_id, public)
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

        return _sound(lambda: read_key_file(path, VEHICLES_SCHEMA, parse, secret=True))

    def write_bundles(
        self, directory: Path, agents: Sequence[int] | None = None, *, overwrite: bool = False
    ) -> list[Path]:
        """A file for each vehicle, which nobody else can read; which files those are."""
        bundles = self.bundles(agents)
        paths = {agent_id: directory / bundle_name(agent_id) for agent_id in bundles}
        for path in paths.values():
            if path.exists() and not overwrite:
                raise KeysError(f"{path} exists, and may be of a later epoch: add --overwrite to replace it")
        try:
            directory.mkdir(mode=HOME_MODE, parents=True, exist_ok=True)
            for agent_id, path in paths.items():
                write_bundle(path, bundles[agent_id])
        except OSError as error:
            raise _refused(directory, error) from None
        return [*paths.values()]

    def revocation(self, public: PublicKeys | None = None) -> Revocation | None:
        """The last one that was made here, with these `public` keys or those that are here; None if nobody is."""
        path = self.directory / REVOCATION_NAME
        return load_revocation(path, public or self.public()) if path.exists() else None

    def revoke(self, agents: Sequence[int]) -> Revocation:
        """Revoke these, too: a new revocation, one number on, which says all that are revoked so far."""
        public, last = self.public(), self.revocation()
        before = last.revoked if last else frozenset[int]()
        revoked = before.union(agents)
        strangers = sorted(revoked - {*public.vehicles})
        if strangers:
            raise _stranger(strangers[0], public)
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
            raise _refused(self.directory, error) from None
        return revocation

    def authority(self, public: PublicKeys) -> bytes:
        """The authority's private key, which is that of these public ones."""

        def parse(document: dict[str, Any]) -> bytes:
            key = key_in(document, "private_key", KEY_BYTES)
            if public_key_of(key) != public.authority:
                raise KeyFileError(f"this key of the authority does not match {PUBLIC_NAME}")
            return key

        return _sound(lambda: read_key_file(self.directory / AUTHORITY_NAME, AUTHORITY_SCHEMA, parse, secret=True))


def load_depot_key(path: Path) -> Depot:
    """Who opens what was sealed: by the key in a file, or in the directory of a mission's keys. Raises KeysError."""
    file = path / DEPOT_NAME if path.is_dir() else path

    def parse(document: dict[str, Any]) -> Depot:
        return Depot(key_in(document, "mission", MISSION_ID_BYTES), key_in(document, "private_key", KEY_BYTES))

    return _sound(lambda: read_key_file(file, DEPOT_SCHEMA, parse, secret=True))


def load_revocation(path: Path, public: PublicKeys) -> Revocation:
    """The revocation in a file, if the authority of this mission signed it. Raises KeysError."""

    def parse(document: dict[str, Any]) -> Revocation:
        _check_mission(document, public)
        try:
            body = base64.b64decode(str(document.get("message")), validate=True)
            return Revocation.decode(body, public.authority, public.mission)
        except (binascii.Error, ValueError) as error:
            reason = error if isinstance(error, RevocationError) else "not base64"
            raise KeyFileError(f"`message` is {reason}") from None

    return _sound(lambda: read_key_file(path, REVOCATION_SCHEMA, parse, secret=False))


def write_revocation(path: Path, revocation: Revocation, public: PublicKeys) -> None:
    """Raises OSError."""
    message = base64.b64encode(revocation.encode()).decode("ascii")
    document = {"schema": REVOCATION_SCHEMA, "mission": public.mission.hex(), "message": message}
    write_key_file(path, document, secret=False)


def _check_mission(document: Mapping[str, Any], public: PublicKeys) -> None:
    if key_in(document, "mission", MISSION_ID_BYTES) != public.mission:
        raise KeyFileError(f"this file belongs to another mission than {PUBLIC_NAME}")


def _sound(read: Callable[[], T]) -> T:
    """Raises KeysError."""
    try:
        return read()
    except KeyFileError as error:
        raise KeysError(str(error)) from None


def _refused(directory: Path, error: OSError) -> MachineError:
    return MachineError(f"{directory} cannot be written: {error.strerror}; choose another directory")


def _stranger(agent_id: int, public: PublicKeys) -> KeysError:
    return KeysError(f"agent {agent_id} is not in this mission, which has {listed(public.vehicles)}")


def listed(agents: Iterable[int]) -> str:
    """Some agents, in words."""
    first, *others = sorted({*agents})
    shown = ", ".join(map(str, [first, *others[:MOST_NAMED]])) + (", ..." if len(others) > MOST_NAMED else "")
    return f"agents {shown}" if others else f"agent {shown}"


class Authority:
    """Each revocation says all that were revoked so far; `last` was made before, if any was.

    Without its `private_key` there are no others. What is revoked here is written nowhere: a mission that is played
    leaves what is at home as it was.
    """

    def __init__(self, public: PublicKeys, private_key: bytes | None, last: Revocation | None = None) -> None:
        self._public = public
        self._private_key = private_key
        self._last = last

    @classmethod
    def of(cls, keys: KeySet) -> "Authority":
        """Of keys that were made just now."""
        return cls(keys.public, keys.authority)

    @classmethod
    def in_directory(cls, home: Home, public: PublicKeys) -> "Authority":
        """By what is there: the authority's key, the last revocation, both, or nothing. Raises KeysError."""
        private_key = home.authority(public) if (home.directory / AUTHORITY_NAME).exists() else None
        return cls(public, private_key, home.revocation(public))

    @property
    def revoked(self) -> frozenset[int]:
        """All by now."""
        return self._last.revoked if self._last else frozenset()

    def refuse(self, agents: Iterable[int], directory: object) -> None:
        """Raises KeysError if it cannot revoke these. `directory` is where its keys were looked for."""
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
        """The revocation of this one, as a message's body: that which was made before if it says so, or the next."""
        if self._last is None or agent_id not in self._last.revoked:
            assert self._private_key is not None, "was refused"
            signer = Ed25519PrivateKey.from_private_bytes(self._private_key)
            number = self._last.number + 1 if self._last else 1
            self._last = Revocation.signed(signer, self._public.mission, number, self.revoked | {agent_id})
        return self._last.encode()
