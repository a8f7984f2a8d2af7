"""The keys of a secured mission's vehicles: fresh ones, or those of a directory; and how they are handed out.

Programs find theirs outside of the run directory, which holds no secret, and only while the run goes on.
"""

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from harness.errors import MachineError, ScenarioError
from harness.scenario import Scenario

if TYPE_CHECKING:
    from ucp.secure.bundle import Bundle

FRESH = "fresh"
FRESH_BYTES = 32


def bundles_of(scenario: Scenario, secret: bytes) -> Mapping[int, "Bundle"]:
    """Each vehicle's bundle; none if the scenario is not secured. Fresh keys come of `secret`, 32 bytes.

    Raises ScenarioError, or MachineError where nothing can be secured.
    """
    if scenario.security is None:
        return {}
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
        return {agent_id: fresh.bundle(agent_id) for agent_id in scenario.roster}
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
    return bundles


class Handed:
    """Each vehicle's directory with its bundle, which nobody else reads; none of a mission that is not secured."""

    def __init__(self, bundles: Mapping[int, "Bundle"], directory: Path) -> None:
        self._bundles = bundles
        self.directories = {agent_id: directory / str(agent_id) for agent_id in bundles}

    def hand(self, agent_id: int, *, kept: bool) -> Path | None:
        """The vehicle's bundle, anew from home unless what it had is `kept`. Raises OSError."""
        directory = self.directories.get(agent_id)
        if directory is None:
            return None
        from ucp.secure.bundle import bundle_name, write_bundle

        directory.mkdir(exist_ok=True)
        path = directory / bundle_name(agent_id)
        if not (kept and path.exists()):
            write_bundle(path, self._bundles[agent_id])
        return path


@contextmanager
def handed_out(scenario: Scenario) -> Iterator[Handed]:
    """The vehicles' keys, until the run is over. Raises as `bundles_of`, and OSError."""
    bundles = bundles_of(scenario, os.urandom(FRESH_BYTES))
    if not bundles:
        yield Handed({}, Path())
        return
    with tempfile.TemporaryDirectory(prefix="ucp-keys-") as directory:
        yield Handed(bundles, Path(directory))
