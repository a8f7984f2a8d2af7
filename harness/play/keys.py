"""The keys of a secured mission's vehicles: fresh ones, or those of a directory; and how they are handed out.

Programs find theirs outside of the run directory, which holds no secret, and only while the run goes on.
"""

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from harness.errors import MachineError, ScenarioError
from harness.scenario import Scenario
from ucp.sealed import seal_to

if TYPE_CHECKING:
    from ucp.secure.bundle import Bundle, PublicKeys

FRESH = "fresh"
FRESH_BYTES = 32


class Authority:
    """Who takes keys back: each revocation says all that were revoked so far."""

    def __init__(self, private_key: bytes, mission: bytes) -> None:
        self._private_key = private_key
        self._mission = mission
        self._revoked: list[int] = []

    def revoke(self, agent_id: int) -> bytes:
        """The next revocation, as a message's body."""
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        from ucp.secure.revocation import Revocation

        self._revoked.append(agent_id)
        signer = Ed25519PrivateKey.from_private_bytes(self._private_key)
        return Revocation.signed(signer, self._mission, len(self._revoked), self._revoked).encode()


@dataclass(frozen=True)
class MissionKeys:
    """The keys of a secured mission: each vehicle's bundle, and who revokes them, if that is known here."""

    bundles: Mapping[int, "Bundle"]
    authority: Authority | None = None
    seals: bool = False

    @property
    def public(self) -> "PublicKeys":
        """What everybody may know of them."""
        return next(iter(self.bundles.values())).public

    def sealed_to_depot(self, initial_data: bytes) -> bytes:
        """The inception block's data, which says to whom event data is sealed, if it is."""
        return seal_to(initial_data, self.public.depot) if self.seals and self.public.depot else initial_data

    def revoke(self, agent_id: int) -> bytes:
        """The next revocation, as a message's body."""
        assert self.authority is not None, "a scenario that revokes has fresh keys"
        return self.authority.revoke(agent_id)


def keys_of(scenario: Scenario, secret: bytes) -> MissionKeys | None:
    """The mission's keys; None if it is not secured. Fresh ones come of `secret`, 32 bytes.

    Raises ScenarioError, or MachineError where nothing can be secured.
    """
    if scenario.security is None:
        return None
    try:
        from ucp.secure.bundle import KeySet, bundle_name, load_bundle
        from ucp.secure.keyfile import KeyFileError
    except ModuleNotFoundError:
        raise MachineError(
            "a secured mission needs the package cryptography, which comes with the extra `secure`: install that, or "
            "leave out `security`"
        ) from None
    if scenario.security.keys == FRESH:
        fresh = KeySet.derived(secret, scenario.roster, seals=scenario.security.seal)
        handed = {agent_id: fresh.bundle(agent_id) for agent_id in scenario.roster}
        return MissionKeys(handed, Authority(fresh.authority, fresh.public.mission), scenario.security.seal)
    if any(fault.needs_keys for fault in scenario.faults_in_order()):
        raise ScenarioError("the timeline revokes keys, for which only `security.keys: fresh` has the authority's here")
    directory = Path(scenario.security.keys)
    try:
        bundles = {agent_id: load_bundle(directory / bundle_name(agent_id)) for agent_id in scenario.roster}
    except KeyFileError as error:
        raise ScenarioError(f"`security.keys`: {error}; make keys with `ucp-harness keys new`") from None
    if scenario.security.seal and any(bundle.public.depot is None for bundle in bundles.values()):
        raise ScenarioError(
            f"`security.seal`: the keys in {directory} have no depot's: `ucp-harness keys new` makes one"
        )
    for agent_id, bundle in bundles.items():
        if bundle.agent_id != agent_id or not {*scenario.roster} <= bundle.public.vehicles.keys():
            raise ScenarioError(
                f"`security.keys`: {directory / bundle_name(agent_id)} is not of agent {agent_id} in a mission of "
                f"{len(scenario.roster)} such agents: make keys for this roster with `ucp-harness keys new`"
            )
    return MissionKeys(bundles, seals=scenario.security.seal)


class Handed:
    """A directory for each vehicle with its bundle, which nobody else reads; `keys` are the mission's, if any."""

    def __init__(self, keys: MissionKeys | None, directory: Path) -> None:
        self.keys = keys
        self.directories = {agent_id: directory / str(agent_id) for agent_id in (keys.bundles if keys else ())}

    def hand(self, agent_id: int, *, kept: bool) -> Path | None:
        """The vehicle's bundle, anew from home unless what it had is `kept`. Raises OSError."""
        if self.keys is None:
            return None
        from ucp.secure.bundle import bundle_name, write_bundle

        path = self.directories[agent_id] / bundle_name(agent_id)
        if not (kept and path.exists()):
            write_bundle(path, self.keys.bundles[agent_id])
        return path


@contextmanager
def handed_out(scenario: Scenario) -> Iterator[Handed]:
    """The vehicles' keys, until the run is over. Raises as `keys_of`, and OSError."""
    keys = keys_of(scenario, os.urandom(FRESH_BYTES))
    if keys is None:
        yield Handed(None, Path())
        return
    with tempfile.TemporaryDirectory(prefix="ucp-keys-") as directory:
        handed = Handed(keys, Path(directory))
        for vehicle in handed.directories.values():
            vehicle.mkdir()
        yield handed
