"""The keys of a secured mission's vehicles: fresh ones, or those of a directory; and how they are handed out.

Programs find theirs outside of the run directory, which holds no secret, and only while the run goes on.
"""

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from harness.errors import MachineError, ScenarioError
from harness.scenario import Scenario
from ucp.sealed import seal_to

if TYPE_CHECKING:
    from harness.play.keyring.key_directory import Authority
    from ucp.secure.bundle import Bundle, PublicKeys

FRESH = "fresh"
FRESH_BYTES = 32


@dataclass(frozen=True)
class MissionKeys:
    """The keys of a secured mission: each vehicle's bundle, and who revokes them."""

    bundles: Mapping[int, "Bundle"]
    authority: "Authority"
    seals: bool

    @property
    def public(self) -> "PublicKeys":
        """What everybody may know of them."""
        return next(iter(self.bundles.values())).public

    def sealed_to_depot(self, initial_data: bytes) -> bytes:
        """The inception block's data, which says to whom event data is sealed, if it is."""
        return seal_to(initial_data, self.public.depot) if self.seals and self.public.depot else initial_data

    def revoke(self, agent_id: int) -> bytes:
        """The revocation of this vehicle, as a message's body."""
        return self.authority.revoke(agent_id)


def mission_keys(scenario: Scenario, secret: bytes) -> MissionKeys | None:
    """The mission's keys; None if it is not secured. Fresh ones come of `secret`, 32 bytes.

    Raises ScenarioError, or MachineError where nothing can be secured.
    """
    if scenario.security is None:
        return None
    security = scenario.security
    try:
        from harness.play.keyring.key_directory import Authority
        from ucp.secure.bundle import KeySet
    except ModuleNotFoundError:
        raise MachineError(
            "a secured mission needs the package cryptography: run `pip install 'ucp-harness[secure]'`, or remove "
            "`security`"
        ) from None
    if security.keys == FRESH:
        fresh = KeySet.derived(secret, scenario.roster, seals=security.seal)
        handed = {agent_id: fresh.bundle(agent_id) for agent_id in scenario.roster}
        return MissionKeys(handed, Authority.of(fresh), security.seal)
    directory = Path(security.keys)
    bundles = _bundles_in(directory, scenario.roster)
    if security.seal and any(bundle.public.depot is None for bundle in bundles.values()):
        raise ScenarioError(f"`security.seal`: {directory} has no depot key: make keys with `ucp-harness keys new`")
    return MissionKeys(bundles, _authority_in(directory, bundles, scenario), security.seal)


def refuse_revocations(scenario: Scenario) -> None:
    """Raises ScenarioError if its timeline revokes what nobody here can."""
    mission_keys(scenario, bytes(FRESH_BYTES))


def _bundles_in(directory: Path, roster: Sequence[int]) -> dict[int, "Bundle"]:
    """By vehicle, from the home of the keys, or from where bundles were handed out. Raises ScenarioError."""
    from harness.play.keyring.key_directory import VEHICLES_NAME, Home, KeysError
    from ucp.secure.bundle import bundle_name, load_bundle
    from ucp.secure.keyfile import KeyFileError

    try:
        if (directory / VEHICLES_NAME).exists():
            return Home(directory).bundles(roster, also_revoked=True)
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


def _authority_in(directory: Path, bundles: Mapping[int, "Bundle"], scenario: Scenario) -> "Authority":
    """Who revokes what the timeline says, when it says so. Raises ScenarioError if nobody can."""
    from harness.play.keyring.key_directory import REVOCATION_NAME, Authority, Home, KeysError, listed

    revoking = [fault.agents for fault in scenario.faults_in_order() if fault.needs_keys]
    try:
        authority = Authority.in_directory(Home(directory), next(iter(bundles.values())).public)
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
def key_directories(scenario: Scenario) -> Iterator[KeyDirectories]:
    """The vehicles' keys, until the run is over. Raises as `mission_keys`, and OSError."""
    keys = mission_keys(scenario, os.urandom(FRESH_BYTES))
    if keys is None:
        yield KeyDirectories(None, Path())
        return
    with tempfile.TemporaryDirectory(prefix="ucp-keys-") as directory:
        handed = KeyDirectories(keys, Path(directory))
        for vehicle in handed.directories.values():
            vehicle.mkdir()
        yield handed
