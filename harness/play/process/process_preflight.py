"""Checks before a run with processes: what this machine cannot do."""

import asyncio
import tempfile
from pathlib import Path

from harness.errors import MachineError, ScenarioError
from harness.play._ground_station_check import refuse_what_no_ground_station_sees
from harness.play.process.vehicle_kinds import choose_vehicles
from harness.scenario import Scenario
from harness.scenario.changes import NetworkChange, timeline_of
from netem.conditions import NetworkConditions
from netem.errors import ConditionsError, EngineError, LabUnavailable, NetemError
from netem.lab import Lab
from netem.radio import over_the_air
from netem.tc import may_refuse


def refuse_what_programs_cannot(scenario: Scenario) -> None:
    """Raises HarnessError for what neither processes nor containers can play, or not on this machine."""
    refuse_what_needs_virtual_time(scenario)
    refuse_what_this_machine_cannot(scenario)
    choose_vehicles(scenario)
    refuse_what_no_ground_station_sees(scenario)


def refuse_what_needs_virtual_time(scenario: Scenario) -> None:
    """Raises ScenarioError naming the keys that real processes cannot be given yet."""
    keys = [
        *(["fates"] if scenario.fates else []),
        *(["datagrams"] if scenario.datagrams else []),
        *(["lateness"] if scenario.lateness else []),
        *(["network.channel"] if scenario.network.channel else []),
        *(["clocks"] if scenario.clocks else []),
        *(["timeline.lie"] if any(entry.lie for entry in scenario.timeline) else []),
        *(["events.script.timestamp_us"] if any(event.timestamp_us for event in scenario.events.script) else []),
        *(["events.script.sealed"] if any(event.sealed for event in scenario.events.script) else []),
    ]
    if keys:
        named = ", ".join(f"`{key}`" for key in keys)
        raise ScenarioError(f"{named} need{'s' if len(keys) == 1 else ''} virtual time: use --backend sim")


def network_needs(scenario: Scenario) -> list[str]:
    """What the scenario asks of the network beyond loss and partition, each once.

    Raises ScenarioError for conditions that mean nothing on a clock that runs at the scenario's speedup.
    """
    return list(dict.fromkeys(need for state in _networks(scenario) for need in state.needs()))


def on_the_air(conditions: NetworkConditions, scenario: Scenario) -> NetworkConditions:
    """These conditions between the vehicles, and perfect ones around the rogue node, if the scenario has one."""
    return conditions.with_listener(scenario.rogue, scenario.roster) if scenario.rogue else conditions


def _networks(scenario: Scenario) -> list[NetworkConditions]:
    """Every state of the network, each once, without partitions, on a clock that runs at the scenario's speedup.

    Where a radio will make links differ, also as one in which they do.
    """
    states = [change.conditions for change in timeline_of(scenario) if isinstance(change, NetworkChange)]
    out_of_reach = {frozenset(scenario.roster[:2]): 0.5} if scenario.network.radio else {}
    networks: list[NetworkConditions] = []
    for state in states:
        try:
            network = on_the_air(over_the_air(state, out_of_reach).healed(), scenario).at_speed(scenario.speedup)
        except ConditionsError as error:
            raise ScenarioError(f"`network` at `speedup` {scenario.speedup:g}: {error}") from None
        if network not in networks:
            networks.append(network)
    return networks


def refuse_what_this_machine_cannot(scenario: Scenario) -> None:
    """Raises MachineError, with the way out, if no engine here does what the network asks.

    Tried in a lab of its own, for a fraction of a second, and only if it asks for more than loss and partitions; what
    some kernels refuse although they have netem is rehearsed there.
    """
    needs = network_needs(scenario)
    rehearsed = [network for network in _networks(scenario) if may_refuse(network)]
    if not needs:
        return

    async def attempt(folder: str) -> None:
        async with await Lab.open(scenario.on_the_air, needs=needs, log=Path(folder, "lab.log")) as lab:
            for network in rehearsed:
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
