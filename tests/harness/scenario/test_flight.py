"""Test flight plans of vehicles: plans that are refused, the program and the system ID of each vehicle, and a run."""

import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from harness.errors import MachineError, ScenarioError
from harness.play.process.vehicle_kinds import choose_vehicles
from harness.scenario import Scenario, load_scenario
from sitl.plan import GoTo, Land, Loiter, Plan, TakeOff
from sitl.system_ids import system_ids
from tests.harness.command import harness, processes, write_scenario

TAKE_OFF, LAND = {"take_off": 20}, {"land": True}
GO_100_M_NORTH = {"go_to": [100, 0]}


def loaded(tmp_path: Path, **keys: Any) -> Scenario:
    path = tmp_path / "scenario.yaml"
    path.write_text(yaml.safe_dump({"name": "x", "agents": [1, 2, 118], **keys}))
    return load_scenario(path)


def test_flight_becomes_a_plan_with_the_same_legs(tmp_path: Path) -> None:
    legs = [TAKE_OFF, {"go_to": [100, -5], "speed_ms": 8, "altitude_m": 30}, {"loiter_s": 60}, GO_100_M_NORTH, LAND]
    scenario = loaded(tmp_path, flight=[{"vehicles": [2], "by": "guided", "plan": legs}])
    flight = scenario.flight_of(2)
    assert flight is not None and flight.by == "guided"
    assert flight.to_plan() == Plan((TakeOff(20), GoTo(100, -5, 30, 8), Loiter(60), GoTo(100, 0), Land()))
    assert scenario.flight_of(1) is None


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"plan": []}, r"`flight.0.plan` is \[\]: "),
        ({"plan": [TAKE_OFF] * 101}, "at most 100 items"),
        ({"plan": [{**TAKE_OFF, **LAND}]}, "`flight.0.plan.0`.* needs exactly one of `take_off`, `go_to`, `loiter_s`"),
        ({"plan": [{"take_off": 20, "speed_ms": 5}]}, "`altitude_m` and `speed_ms` belong to a `go_to`"),
        ({"plan": [TAKE_OFF, {"goto": [1, 2]}]}, "`flight.0.plan.1.goto` is unknown: use one of take_off, go_to"),
        ({"plan": [GO_100_M_NORTH]}, r"flight.0.plan, for vehicle 1: the plan of a copter begins with take_off"),
        ({"plan": [TAKE_OFF, {"go_to": [100_000, 100]}]}, "farther than 100 km from home"),
        ({"plan": [TAKE_OFF, {"go_to": [0, float("nan")]}]}, "farther than 100 km from home"),
        ({"plan": [TAKE_OFF], "vehicles": [118]}, "for vehicle 118: leg 1 .* a rover neither takes off nor lands"),
        ({"plan": [TAKE_OFF], "vehicles": [1, 2, 1]}, "`flight` names vehicle 1 twice: a vehicle has one plan"),
        (
            {"plan": [TAKE_OFF], "vehicles": [7]},
            "flight.0.vehicles names vehicle 7, which is not on the roster: use one of 1, 2",
        ),
        ({"plan": [TAKE_OFF], "vehicles": []}, r"`flight.0.vehicles` is \[\]"),
        ({"plan": [TAKE_OFF], "by": "stick"}, "`flight.0.by` is 'stick': it should be 'mission' or 'guided'"),
    ],
)
def test_impossible_plan_is_refused_in_one_sentence(keys: dict[str, Any], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=sentence) as error:
        loaded(tmp_path, vehicles={"types": {118: "rover"}}, flight=[{"vehicles": [1], **keys}])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("vehicles", "sentence"),
    [
        ({"kind": "none"}, "`flight` needs vehicles, but `vehicles.kind` is none"),
        (
            {"types": {2: "plane"}, "binary": "/bin/x"},
            "`vehicles.binary` is one program, but the vehicles are of types copter and plane",
        ),
        ({"types": {7: "plane"}}, "vehicles.types names vehicle 7, which is not on the roster"),
        ({"types": {2: "boat"}}, "`vehicles.types.2` is 'boat': it should be 'copter', 'plane' or 'rover'"),
        ({"home": [0, 0, 10, 0]}, "`vehicles.home` is .* reads latitude and longitude 0 as no position"),
        ({"spacing_m": 0}, "`vehicles.spacing_m` is 0: it should be greater than 0"),
    ],
)
def test_impossible_vehicles_are_refused_in_one_sentence(
    vehicles: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(ScenarioError, match=sentence):
        loaded(tmp_path, vehicles=vehicles, flight=[{"vehicles": [1], "plan": [TAKE_OFF]}])


def test_missing_binary_of_one_type_makes_all_vehicles_embedded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ARDUPILOT_SITL", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name in ("arducopter", "arduplane"):
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(0o755)
    mixed = {"types": {2: "plane"}}
    kinds = choose_vehicles(loaded(tmp_path, vehicles=mixed))
    assert {kind.name for kind in kinds.values()} == {"embedded"}
    assert {vehicle: kind.vehicle_type for vehicle, kind in kinds.items() if vehicle == 2} == {2: "plane"}
    monkeypatch.setenv("ARDUPILOT_SITL", str(tmp_path))
    assert {kind.name for kind in choose_vehicles(loaded(tmp_path, vehicles=mixed)).values()} == {"ardupilot"}
    with_rover = {"types": {2: "plane", 118: "rover"}}  # there is no binary for a rover
    assert {kind.name for kind in choose_vehicles(loaded(tmp_path, vehicles=with_rover)).values()} == {"embedded"}
    with pytest.raises(MachineError, match="no ArduPilot rover"):
        choose_vehicles(loaded(tmp_path, vehicles={**with_rover, "kind": "ardupilot"}))
    assert choose_vehicles(loaded(tmp_path, vehicles={"kind": "none"})) == {}


def test_system_ids_are_unique_up_to_255_vehicles() -> None:
    assert system_ids([1, 2, 118]) == {1: 1, 2: 2, 118: 118}
    ids = system_ids([1, 3, 255, 256, 300, 65535])
    assert ids == {1: 1, 3: 3, 255: 255, 256: 2, 300: 4, 65535: 5}
    full = system_ids(range(200, 455))
    assert len(set(full.values())) == 255
    assert all(1 <= sysid <= 255 for sysid in system_ids(range(1, 1001)).values())


@pytest.mark.lab
def test_swarm_of_three_vehicle_types_flies_its_plans(tmp_path: Path) -> None:
    scenario = write_scenario(
        tmp_path,
        agents=[1, 2, 300],
        duration_s=200,
        speedup=40,
        vehicles={"kind": "embedded", "types": {2: "plane", 300: "rover"}, "spacing_m": 50},
        flight=[
            {"vehicles": [1], "by": "guided", "plan": [TAKE_OFF, {"go_to": [50, 0]}, {"go_to": [0, 0]}, LAND]},
            {"vehicles": [2], "plan": [TAKE_OFF, {"go_to": [300, 0]}]},
            {"vehicles": [300], "plan": [{"go_to": [0, 50], "speed_ms": 5}]},
        ],
    )
    out = tmp_path / "run"
    done = harness("run", scenario, "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    vehicles = json.loads((out / "run.json").read_text())["vehicles"]
    assert [vehicles[one]["type"] for one in ("1", "2", "300")] == ["copter", "plane", "rover"]
    assert vehicles["300"]["sysid"] == 3
    assert not vehicles["1"]["armed"] and vehicles["1"]["altitude_m"] < 1  # it has landed
    assert vehicles["2"]["armed"] and vehicles["2"]["altitude_m"] == 20
    assert vehicles["300"]["last_text"].startswith("Reached command")


WRONG_SYSTEM_ID = """
import socket, time
from pymavlink.dialects.v20 import common
mav = common.MAVLink(None, srcSystem=9, srcComponent=1)
server = socket.create_server(("127.0.0.1", 5760))
client, _ = server.accept()
while True:
    client.sendall(common.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(mav))
    time.sleep(0.1)
"""


@pytest.mark.lab
@pytest.mark.any_user
def test_vehicle_with_a_wrong_system_id_is_named_and_killed(tmp_path: Path) -> None:
    binary = tmp_path / "arducopter"
    (tmp_path / "stranger.py").write_text(WRONG_SYSTEM_ID)
    binary.write_text(f"#!/bin/sh\nexec {shlex.quote(sys.executable)} '{tmp_path}/stranger.py'\n")
    binary.chmod(0o755)
    scenario = write_scenario(tmp_path, vehicles={"binary": str(binary)}, duration_s=2000)
    out = tmp_path / "run"
    done = harness("run", scenario, "--out", out)
    record = json.loads((out / "run.json").read_text())
    assert record["outcome"] == "failed" and done.returncode != 0
    assert re.match(r"vehicle [123] did not introduce itself: .* it sends the system ID 9", record["outcome_detail"])
    assert f"without default parameters: put ArduPilot's copter.parm beside {binary}" in record["outcome_detail"]
    assert not processes(out)
