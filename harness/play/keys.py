"""The keys of a secured mission's vehicles: fresh ones, or those of a directory."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from harness.errors import MachineError, ScenarioError
from harness.scenario import Scenario

if TYPE_CHECKING:
    from ucp.secure.bundle import Bundle

FRESH = "fresh"


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
