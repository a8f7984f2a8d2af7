"""Write the mission file that an agent reads at its start (`ucp-mission/1`, see ucp/contract/CONTRACT.md)."""

import base64
from typing import Any

from harness.play.backend import agent_seed
from harness.scenario import Scenario
from harness.scenario.agent_options import EventOptions
from sitl.vehicle import AGENT_PORT
from ucp.features import CONTRACT, needed_features
from ucp.messages import PORT
from ucp.mission import SCHEMA

NO_QUIRKS = {"ignore_commit": 0.0, "crash_on_tie": False, "early_phase3_expiry": False, "stale_chain_hash": False}
"""The quirks (deliberate errors for tests of the checker) that every mission file lists. They are switched off. Other
quirks are listed only if the scenario requests them.
"""


def mission_file(
    agent_id: int,
    scenario: Scenario,
    seed: int,
    initial_data: bytes,
    *,
    address: str,
    broadcast: str,
    with_vehicle: bool,
    incarnation: int = 1,
    epoch_us: int | None = None,
    store: str | None = None,
    bundle: str | None = None,
) -> dict[str, Any]:
    """Return the mission file of an agent as a JSON object.

    - `seed`: seed of the run. The file has a seed derived from it, which differs for each agent and incarnation.
    - `epoch_us`: start time of the mission, if the agent joins an active mission.
    - `store`: file in which the agent stores its state. None: the agent has no disk.
    - `bundle`: file with the agent's keys in a secured mission.
    """
    events = scenario.events
    document = {
        "schema": SCHEMA,
        "contract": CONTRACT,
        "features": [],
        "agent_id": agent_id,
        "roster": list(scenario.roster),
        "initial_data": base64.b64encode(initial_data).decode("ascii"),
        "network": {"address": address, "broadcast": broadcast, "port": PORT},
        "events": {
            "source": _source(events, with_vehicle),
            "mean_s": events.mean_s,
            "position_interval_s": events.position_interval_s,
            "log": list(events.log),
            "vehicle_host": "127.0.0.1",
            "vehicle_port": AGENT_PORT,
        },
        "settings": scenario.settings_of(agent_id).to_json(),
        "quirks": {**NO_QUIRKS, **scenario.quirks_of(agent_id)},
        "seed": agent_seed(seed, agent_id, incarnation),
        "speedup": scenario.speedup,
        "epoch_us": epoch_us,
        "store": store,
    }
    if bundle is not None:
        document["security"] = {"bundle": bundle}
    return document | {"features": needed_features(document)}


def _source(events: EventOptions, with_vehicle: bool) -> str:
    """Return the event source for the mission file. The source of scripted events is "none", because the harness sends
    these events to the agent. An agent without a vehicle draws random events.
    """
    if events.source == "scripted":
        return "none"
    return events.source if with_vehicle else "random"
