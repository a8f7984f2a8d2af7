"""Check before a run with processes or containers that this machine can run the scenario."""

import asyncio
import tempfile
from pathlib import Path

from harness.errors import MachineError, ScenarioError
from harness.play._ground_station_check import refuse_unreachable_ground_station
from harness.play._vehicle_keys import require_key_packages
from harness.play.process.vehicle_kinds import choose_vehicles
from harness.scenario import Scenario
from harness.scenario.changes import NetworkChange, timeline_of
from netem.conditions import NetworkConditions
from netem.errors import ConditionsError, EngineError, LabUnavailable, NetemError
from netem.lab import Lab
from netem.radio import over_the_air
from netem.tc import may_refuse


def refuse_unplayable(scenario: Scenario) -> None:
    """Raise HarnessError if the scenario needs virtual time, or if this machine cannot run it."""
    refuse_virtual_time_keys(scenario)
    refuse_unsupported_network(scenario)
    choose_vehicles(scenario)
    refuse_unreachable_ground_station(scenario)
    require_key_packages(scenario)


def refuse_virtual_time_keys(scenario: Scenario) -> None:
    """Raise ScenarioError if the scenario contains keys that need virtual time. The error message lists these keys."""
    keys = [
        *(["fates"] if scenario.fates else []),
        *(["datagrams"] if scenario.datagrams else []),
        *(["lateness"] if scenario.lateness else []),
        *(["clocks"] if scenario.clocks else []),
        *(["timeline.lie"] if any(entry.lie for entry in scenario.timeline) else []),
        *(["events.script.timestamp_us"] if any(event.timestamp_us for event in scenario.events.script) else []),
        *(["events.script.sealed"] if any(event.sealed for event in scenario.events.script) else []),
    ]
    if keys:
        named = ", ".join(f"`{key}`" for key in keys)
        raise ScenarioError(f"{named} need{'s' if len(keys) == 1 else ''} virtual time: use --backend sim")


def network_needs(scenario: Scenario) -> list[str]:
    """Return the network features that the scenario needs, except loss and partitions.

    Raises ScenarioError for conditions that are impossible at the speedup of the scenario.
    """
    return list(dict.fromkeys(need for state in _network_states(scenario) for need in state.needs()))


def add_rogue_listener(conditions: NetworkConditions, scenario: Scenario) -> NetworkConditions:
    """Return the network conditions. If the scenario has a rogue node, add links without loss and delay from the agents
    to the rogue node.
    """
    return conditions.with_listener(scenario.rogue, scenario.roster) if scenario.rogue else conditions


def _network_states(scenario: Scenario) -> list[NetworkConditions]:
    """Return all different network conditions that occur in the scenario, without partitions and at the scenario's
    speed.

    If the scenario has a radio model, one link in each of these conditions has an additional loss, so that the losses
    of links differ as during a flight.
    """
    states = [change.conditions for change in timeline_of(scenario) if isinstance(change, NetworkChange)]
    out_of_reach = {frozenset(scenario.roster[:2]): 0.5} if scenario.network.radio else {}
    networks: list[NetworkConditions] = []
    for state in states:
        try:
            network = add_rogue_listener(over_the_air(state, out_of_reach).healed(), scenario).at_speed(
                scenario.speedup
            )
        except ConditionsError as error:
            raise ScenarioError(f"`network` at `speedup` {scenario.speedup:g}: {error}") from None
        if network not in networks:
            networks.append(network)
    return networks


def refuse_unsupported_network(scenario: Scenario) -> None:
    """Raise MachineError with a solution if this machine cannot create the network conditions of the scenario.

    If the scenario needs more than loss and partitions, the function opens a lab for a fraction of a second and applies
    the conditions of the scenario, because some kernels reject some conditions.
    """
    needs = network_needs(scenario)
    uncertain = [network for network in _network_states(scenario) if may_refuse(network)]
    if not needs:
        return

    async def attempt(folder: str) -> None:
        async with await Lab.open(scenario.network_nodes, needs=needs, log=Path(folder, "lab.log")) as lab:
            for network in uncertain:
                await lab.apply(network)

    with tempfile.TemporaryDirectory() as folder:
        try:
            asyncio.run(attempt(folder))
        except LabUnavailable as error:
            raise MachineError(str(error)) from None
        except EngineError as error:
            raise MachineError(
                "this kernel does not support these network conditions; play the scenario in virtual time (--backend "
                f"sim): {error}"
            ) from None
        except NetemError as error:
            raise MachineError(f"the lab could not be built: {error}") from None
