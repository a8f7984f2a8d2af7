"""What to log is chosen in a scenario, stands in the mission file, and reaches the chain."""

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
from harness.scenario.agent_options import Events
from tests.ucp.test_node import AgentUnderTest, mission
from tests.ucp.test_telemetry import frames, heartbeat, text
from ucp.events import decode_events
from ucp.mission import MissionError, parse_mission
from ucp.telemetry import DEFAULT_LOG, EVENT_KINDS, MODE_CHANGE, STATUS_TEXT


def parsed(**events: Any) -> tuple[str, ...]:
    return parse_mission(mission(events={"source": "mavlink", **events})).events.log


def test_a_mission_file_that_chooses_nothing_logs_as_ever() -> None:
    assert parsed() == DEFAULT_LOG == ("mode", "arming", "text", "position")


def test_a_mission_file_can_choose_every_kind() -> None:
    assert parsed(log=list(EVENT_KINDS)) == tuple(EVENT_KINDS)
    assert parsed(log=[]) == ()


@pytest.mark.parametrize("log", ["mode", None, [1], [["mode"]], [{}], ["mode", "weather"], {"mode": True}])
def test_a_mission_file_with_a_wrong_choice_is_refused_in_a_sentence(log: Any) -> None:
    with pytest.raises(MissionError, match=r"`events\.log` must list kinds of events \(mode, arming, text, waypoint"):
        parsed(log=log)


def load(tmp_path: Path, **events: Any) -> Events:
    path = tmp_path / "scenario.yaml"
    path.write_text(json.dumps({"name": "x", "events": {"source": "mavlink", **events}}))
    return load_scenario(path).events


def test_a_scenario_chooses_what_to_log(tmp_path: Path) -> None:
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
def test_a_scenario_with_a_wrong_choice_is_refused_in_a_sentence(tmp_path: Path, log: Any, sentence: str) -> None:
    with pytest.raises(ScenarioError, match=sentence):
        load(tmp_path, log=log)


@pytest.fixture
def vehicle_port() -> Iterator[int]:
    """A vehicle that says its mode and a text to whoever connects."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def speak() -> None:
            client, _ = server.accept()
            with client:
                client.sendall(frames(heartbeat(4, armed=True), text("the text")))
                while client.recv(4096):
                    pass

        threading.Thread(target=speak, daemon=True).start()
        yield server.getsockname()[1]


@pytest.mark.parametrize(("log", "ids"), [(["text"], [STATUS_TEXT]), (["mode", "text"], [MODE_CHANGE, STATUS_TEXT])])
def test_an_agent_logs_what_its_mission_chose(
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
