"""Fuzz target: a mission file. The reader refuses it in one sentence, or the writer reproduces it and an agent can
execute the mission.
"""

import base64
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

from harness.archive.traces import HEADER
from harness.checker.steps.trace_header import checked
from harness.play.process.agent_mission import mission_file
from tests.fuzz.finding import require, sound
from tests.harness.virtual import scenario
from ucp.agent import Agent
from ucp.clock import MissionClock
from ucp.events import LoggableEvent, RandomEvents
from ucp.export import export_chain
from ucp.mission import SCHEMA, Mission, MissionError, load_mission, parse_mission
from ucp.quirks import wrong_handlers
from ucp.telemetry import TelemetryEvents
from ucp.trace import header_line


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / "1.mission.json"
        path.write_bytes(data)
        try:
            mission = load_mission(path)
        except MissionError as error:
            sound(str(error))
            return
    require(parse_mission(json.loads(json.dumps(_written(mission)))) == mission, "a mission is read otherwise")
    _fly(mission)


def _written(mission: Mission) -> dict[str, Any]:
    """Return the mission in the form of a mission file."""
    document = dataclasses.asdict(mission)
    return {**document, "schema": SCHEMA, "initial_data": base64.b64encode(mission.initial_data).decode()}


def _fly(mission: Mission) -> None:
    """Create an agent from the mission, as `ucp.node` does at its start."""
    lots = Random(mission.seed)
    mission.events.vehicle_host.encode("idna")
    agent = Agent(
        mission.agent_id,
        mission.roster,
        mission.initial_data,
        mission.settings,
        handlers=wrong_handlers(mission.quirks, lots),
    )
    clock = MissionClock(mission.speedup)
    clock.start(mission.epoch_us or 0)
    settings = dataclasses.asdict(mission.settings)
    its_clock = {"epoch_us": mission.epoch_us or 0, "speedup": mission.speedup}
    line = header_line(mission.agent_id, list(mission.roster), mission.initial_data, settings, its_clock)
    checked(HEADER.validate_json(line))
    if mission.events.mean_s < 1e4:  # with a larger mean, no event occurs for hours
        RandomEvents(lots, mission.events.mean_s).next()
    TelemetryEvents(mission.events.position_interval_s, lots, mission.events.log)
    clock.wall_s(mission.settings.vote_timeout_s)
    event = LoggableEvent(clock.timestamp_us(0.0), 1, b"")
    if event.encoded_bytes <= mission.settings.max_event_bytes:
        for _ in range(mission.settings.max_block_bytes // event.encoded_bytes % 100 + 1):
            agent.add_event(event, 0.0)
    for entry in agent.trace():
        entry.to_line()
    json.dumps(export_chain(agent.state, clock.timestamp_us(0.0)))


def seeds(flown: Path) -> Iterator[bytes]:
    asked = scenario(agents=3, quirks={"ignore_commit": 0.5})
    document = mission_file(2, asked, 1, b"fuzz", address="127.0.0.1", broadcast="127.255.255.255", with_vehicle=True)
    yield json.dumps(document).encode()
    smallest = {key: document[key] for key in ("schema", "agent_id", "roster", "initial_data", "network", "seed")}
    yield json.dumps({**smallest, "events": {}, "speedup": 1, "epoch_us": None, "store": "2.store"}).encode()
