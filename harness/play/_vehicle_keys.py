"""Provide the keys of the vehicles of a secured mission, as objects and as files for agent programs.

The keys are made for the run, or come from a directory. Agent programs find their keys in temporary directories, which
exist only during the run. The run directory contains no secret.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from harness.errors import ScenarioError, extra
from harness.play.memory_directory import KEYS_PREFIX, memory_directory, no_core_files
from harness.scenario import Scenario
from ucp.sealed import seal_to

if TYPE_CHECKING:
    from harness.play.keyring.key_directory import RevocationAuthority
    from ucp.secure.bundle import Bundle, PublicKeys

FRESH = "fresh"
FRESH_BYTES = 32


@dataclass(frozen=True)
class MissionKeys:
    """The keys of a secured mission: the secret keys of each vehicle, and the authority that can revoke the keys of a
    vehicle.
    """

    bundles: Mapping[int, "Bundle"]
    authority: "RevocationAuthority"
    seals: bool

    @property
    def public(self) -> "PublicKeys":
        """The public keys of the secured mission."""
        return next(iter(self.bundles.values())).public

    def add_depot_key(self, initial_data: bytes) -> bytes:
        """Return the data of the inception block, the first block of each chain. If event data are encrypted, append
        the depot's public key, with which agents encrypt these data. The depot collects the records after the flight,
        and decrypts them with its private key.
        """
        return seal_to(initial_data, self.public.depot) if self.seals and self.public.depot else initial_data

    def revoke(self, agent_id: int) -> bytes:
        """Return the body of the signed message that revokes the keys of this vehicle."""
        return self.authority.revoke(agent_id)


def mission_keys(scenario: Scenario, secret: bytes) -> MissionKeys | None:
    """Return the keys of the mission. Return None if the mission is not secured.

    Fresh keys are derived from `secret`, which has 32 bytes. Raises ScenarioError for unusable keys, and MachineError
    if the package cryptography is missing.
    """
    if scenario.security is None:
        return None
    security = scenario.security
    require_key_packages(scenario)
    from harness.play.keyring.key_directory import RevocationAuthority
    from ucp.secure.bundle import KeySet

    if security.keys == FRESH:
        fresh = KeySet.derived(secret, scenario.roster, seals=security.seal)
        bundles = {agent_id: fresh.bundle(agent_id) for agent_id in scenario.roster}
        return MissionKeys(bundles, RevocationAuthority.of(fresh), security.seal)
    directory = Path(security.keys)
    bundles = _bundles_in(directory, scenario.roster)
    if security.seal and any(bundle.public.depot is None for bundle in bundles.values()):
        raise ScenarioError(f"`security.seal`: {directory} has no depot key: make keys with `ucp-harness keys new`")
    keys = MissionKeys(bundles, _authority_in(directory, bundles, scenario), security.seal)
    if security.fingerprint not in (None, keys.public.fingerprint):
        raise ScenarioError(
            f"`security.fingerprint`: {directory} has other public keys, with the fingerprint "
            f"{keys.public.fingerprint}: use the directory of this mission, or correct the fingerprint"
        )
    return keys


def require_key_packages(scenario: Scenario) -> None:
    """Raise MachineError if the mission is secured and the package cryptography is missing."""
    if scenario.security is not None:
        with extra("secure", "a secured mission"):
            import cryptography  # noqa: F401


def refuse_revocations(scenario: Scenario) -> None:
    """Raise ScenarioError if the scenario revokes the keys of a vehicle, but this machine lacks the key that must sign
    the revocation.
    """
    mission_keys(scenario, bytes(FRESH_BYTES))


def _bundles_in(directory: Path, roster: Sequence[int]) -> dict[int, "Bundle"]:
    """Return the secret keys of the vehicles from a directory. Raises ScenarioError if files are missing or invalid."""
    from harness.play.keyring.key_directory import VEHICLES_NAME, KeyDirectory, KeysError
    from ucp.secure.bundle import bundle_name, load_bundle
    from ucp.secure.keyfile import KeyFileError

    try:
        if (directory / VEHICLES_NAME).exists():
            return KeyDirectory(directory).bundles(roster, also_revoked=True)
        bundles = {agent_id: load_bundle(directory / bundle_name(agent_id)) for agent_id in roster}
    except (KeyFileError, KeysError) as error:
        raise ScenarioError(f"`security.keys`: {error}; make keys with `ucp-harness keys new`") from None
    for agent_id, bundle in bundles.items():
        if bundle.agent_id != agent_id or not {*roster} <= bundle.public.vehicles.keys():
            raise ScenarioError(
                f"`security.keys`: {directory / bundle_name(agent_id)} does not belong to agent {agent_id} in a "
                f"mission with these {len(roster)} agents: make keys for this roster with `ucp-harness keys new`"
            )
    if len({bundle.public.mission for bundle in bundles.values()}) > 1:
        raise ScenarioError(
            f"`security.keys`: the bundles in {directory} belong to several missions: write those of one mission with "
            "`ucp-harness keys bundle`"
        )
    return bundles


def _authority_in(directory: Path, bundles: Mapping[int, "Bundle"], scenario: Scenario) -> "RevocationAuthority":
    """Return the authority that can revoke keys, from its key file in the directory. Raises ScenarioError if the file
    is missing.
    """
    from harness.play.keyring.key_directory import REVOCATION_NAME, KeyDirectory, KeysError, RevocationAuthority, listed

    revoking = [fault.agents for fault in scenario.faults_in_order() if fault.needs_keys]
    try:
        authority = RevocationAuthority.in_directory(KeyDirectory(directory), next(iter(bundles.values())).public)
        authority.refuse((agent_id for agents in revoking for agent_id in agents), directory)
    except KeysError as error:
        raise ScenarioError(f"`security.keys`: {error}") from None
    if early := authority.revoked.intersection(scenario.roster).difference(*revoking[:1]):
        raise ScenarioError(
            f"`security.keys`: {directory / REVOCATION_NAME} revokes {listed(early)} before the mission: remove it "
            "from `agents`, or list it in the first `revoke` of the timeline"
        )
    return authority


class KeyDirectories:
    """Directories with the secret keys of the vehicles, one for each vehicle. `keys` is None if the mission is not
    secured.
    """

    def __init__(self, keys: MissionKeys | None, directory: Path) -> None:
        self.keys = keys
        self.directories = {agent_id: directory / str(agent_id) for agent_id in (keys.bundles if keys else ())}

    def write_bundle(self, agent_id: int, *, kept: bool) -> Path | None:
        """Write the file with the vehicle's keys, and return its path. Return None without keys. If `kept` is true, the
        vehicle kept its disk, so an existing file stays unchanged. Raises OSError.
        """
        if self.keys is None:
            return None
        from ucp.secure.bundle import bundle_name, write_bundle

        path = self.directories[agent_id] / bundle_name(agent_id)
        again = path.exists()
        if not (kept and again):
            bundle = self.keys.bundles[agent_id]
            write_bundle(path, bundle.used() if again else bundle)
        return path


@contextmanager
def key_directories(scenario: Scenario) -> Iterator[KeyDirectories]:
    """Create the directories with keys for a run, and remove them afterwards. Raises OSError, and the errors of
    `mission_keys`.
    """
    keys = mission_keys(scenario, os.urandom(FRESH_BYTES))
    if keys is None:
        yield KeyDirectories(None, Path())
        return
    with memory_directory(KEYS_PREFIX) as directory, no_core_files():
        directories = KeyDirectories(keys, directory)
        for vehicle in directories.directories.values():
            vehicle.mkdir()
        yield directories
