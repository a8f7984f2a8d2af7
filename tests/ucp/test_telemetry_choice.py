"""Test the key that selects kinds of events in a scenario and in a mission file, and its effect on the agent."""

import base64
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from harness.archive.exports import read_export
from harness.errors import ScenarioError
from harness.scenario import load_scenario
from harness.scenario.agent_options import EventOptions
from tests.ucp.test_node import AgentUnderTest, mission
from tests.ucp.test_telemetry import frames, heartbeat, text
from ucp.events import decode_events
from ucp.mission import MissionError, parse_mission
from ucp.telemetry import DEFAULT_LOG, EVENT_KINDS, MODE_CHANGE, STATUS_TEXT


def parse_log(**events: Any) -> tuple[str, ...]:
    return parse_mission(mission(events={"source": "mavlink", **events})).events.log


def test_mission_file_without_a_selection_logs_the_default_kinds() -> None:
    assert parse_log() == DEFAULT_LOG == ("mode", "arming", "text", "position")


def test_mission_file_can_select_every_kind() -> None:
    assert parse_log(log=list(EVENT_KINDS)) == tuple(EVENT_KINDS)
    assert parse_log(log=[]) == ()


@pytest.mark.parametrize("log", ["mode", None, [1], [["mode"]], [{}], ["mode", "weather"], {"mode": True}])
def test_mission_file_with_a_wrong_selection_is_rejected(log: Any) -> None:
    with pytest.raises(MissionError, match=r"`events\.log` must list kinds of events \(mode, arming, text, waypoint"):
        parse_log(log=log)


def load(tmp_path: Path, **events: Any) -> EventOptions:
    path = tmp_path / "scenario.yaml"
    path.write_text(json.dumps({"name": "x", "events": {"source": "mavlink", **events}}))
    return load_scenario(path).events


def test_scenario_selects_the_kinds_to_log(tmp_path: Path) -> None:
    assert load(tmp_path).log == list(DEFAULT_LOG)
    assert load(tmp_path, log=["waypoint", "failsafe"]).log == ["waypoint", "failsafe"]


@pytest.mark.parametrize(
    ("log", "sentence"),
    [
        (["mode", "weather"], r"`events\.log\.1` is 'weather': it should be 'mode', 'arming', 'text', 'waypoint'"),
        ([], r"`events\.log` is \[\]: .* at least 1 item"),
        ("mode", r"`events\.log` is 'mode': it should be a valid list"),
    ],
)
def test_scenario_with_a_wrong_selection_is_rejected(tmp_path: Path, log: Any, sentence: str) -> None:
    with pytest.raises(ScenarioError, match=sentence):
        load(tmp_path, log=log)


@pytest.fixture
def vehicle_port() -> Iterator[int]:
    """Yield the port of a vehicle that sends its mode and a text to its first client."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            client, _ = server.accept()
            with client:
                client.sendall(frames(heartbeat(4, armed=True), text("the text")))
                while client.recv(4096):
                    pass

        threading.Thread(target=serve, daemon=True).start()
        yield server.getsockname()[1]


@pytest.mark.parametrize(("log", "ids"), [(["text"], [STATUS_TEXT]), (["mode", "text"], [MODE_CHANGE, STATUS_TEXT])])
def test_agent_logs_the_kinds_that_its_mission_selects(
    tmp_path: Path, vehicle_port: int, log: list[str], ids: list[int]
) -> None:
    agent = AgentUnderTest(
        tmp_path, mission(events={"source": "mavlink", "vehicle_port": vehicle_port, "log": log}, roster=[7])
    )

    def logged() -> list[int]:
        agent.ask("export")
        current = base64.b64decode(read_export(tmp_path / "7.chain.json").current_block.event_data)
        return [event.event_id for event in decode_events(current)]

    try:
        agent.start()
        agent.wait_for(lambda: STATUS_TEXT in logged())
        assert logged() == ids
    finally:
        agent.process.kill()
        agent.process.communicate()
