"""Test faults of vehicles in a timeline: GPS, compasses, motors, batteries, and wind."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from harness.archive.run_record import FaultRecord
from harness.scenario import Scenario, explain
from harness.scenario.faults import TIMELINE_FAULTS, VehicleFault
from sitl.modes import MODES
from tests.harness.command import harness, sentences, write_scenario

FAULTS: list[dict[str, Any]] = [
    {"at_s": 20, "lose_gps": [1]},
    {"at_s": 50, "regain_gps": [1]},
    {"at_s": 25, "battery": [2], "volts": 10.4},
    {"at_s": 30, "lose_compass": [2]},
]


def scenario(timeline: list[dict[str, Any]], **vehicles: Any) -> dict[str, Any]:
    kind = {"kind": "embedded", **vehicles}
    return {"name": "trouble", "agents": 2, "duration_s": 60, "timeline": timeline, "vehicles": kind}


def test_every_vehicle_fault_is_a_timeline_key_with_a_record() -> None:
    words = [kind.what for kind in TIMELINE_FAULTS if issubclass(kind, VehicleFault)]
    assert sorted(words) == [
        "battery",
        "breach_fence",
        "lift_fence",
        "lose_compass",
        "lose_gcs",
        "lose_gps",
        "lose_rc",
        "regain_compass",
        "regain_gcs",
        "regain_gps",
        "regain_rc",
        "stop_motor",
        "wind",
    ]
    entry = {"at_s": 5, "wind": [1, 2], "wind_ms": 12, "from_deg": 270}
    (fault,) = Scenario.model_validate(scenario([entry])).faults_in_order()
    record = FaultRecord.model_validate(fault.to_json(5.01))
    assert record.detail == "vehicles 1 2, 12 m/s from 270°"
    assert not (record.kind.ends_incarnation or record.kind.removes_vehicle or record.loses_data)


@pytest.mark.parametrize(
    ("entry", "vehicles", "sentence"),
    [
        ({"lose_gps": [1]}, {"kind": "none"}, "timeline.0.lose_gps needs vehicles, but `vehicles.kind` is none"),
        (
            {"stop_motor": [2]},
            {"type": "plane"},
            "timeline.0.stop_motor applies only to a copter, but vehicle 2 is a plane",
        ),
        ({"battery": [1]}, {}, "a battery needs `volts`, for example 10.4"),
        ({"wind": [1], "wind_ms": 5, "from_deg": 400}, {}, "timeline.0.from_deg"),
        ({"lose_gps": [7]}, {}, "names vehicle 7, which is not on the roster"),
    ],
)
def test_impossible_vehicle_fault_is_refused_in_one_sentence(
    entry: dict[str, Any], vehicles: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValidationError) as refused:
        Scenario.model_validate(scenario([{"at_s": 5, **entry}], **vehicles))
    assert sentence in explain(refused.value, Scenario)


def test_virtual_time_refuses_vehicle_faults(tmp_path: Path) -> None:
    (tmp_path / "trouble.yaml").write_text(yaml.safe_dump(scenario(FAULTS)))
    run = harness("run", tmp_path / "trouble.yaml", "--backend", "sim", "--out", tmp_path / "run")
    assert run.returncode == 2
    assert "`lose_gps`, `battery`, `lose_compass`, `regain_gps` need flying vehicles" in run.stderr


@pytest.mark.lab
@pytest.mark.any_user
def test_run_continues_and_reports_faults_that_no_vehicle_simulated(tmp_path: Path) -> None:
    goes_home = {"parameters": {"BATT_FS_LOW_ACT": 2}}
    written = write_scenario(tmp_path, **{**scenario(FAULTS, each={2: goes_home}), "duration_s": 80, "speedup": 20})
    out = tmp_path / "run"
    done = harness("run", written, "--out", out)
    assert done.returncode == 2, done.stderr
    record = json.loads((out / "run.json").read_text())
    assert record["outcome"] == "completed"
    (unmatched,) = record["unmatched_fates"]
    assert "vehicle 2 (embedded copter) cannot simulate the loss of its compasses" in unmatched
    assert unmatched in " ".join(sentences(done.stderr))
    faults = {vehicle: entry["befallen"] for vehicle, entry in record["vehicles"].items()}
    assert [(fault["what"], fault["parameters"]) for fault in faults["1"]] == [
        ("lose_gps", {"SIM_GPS1_ENABLE": 0.0}),
        ("regain_gps", {"SIM_GPS1_ENABLE": 1.0}),
    ]
    assert [(fault["what"], fault["parameters"]) for fault in faults["2"]] == [
        ("battery", {"SIM_BATT_VOLTAGE": pytest.approx(10.4)}),
        ("lose_compass", {}),
    ]
    modes = {vehicle: entry["mode"] for vehicle, entry in record["vehicles"].items()}
    assert modes == {"1": MODES["copter"]["LAND"], "2": MODES["copter"]["RTL"]}
    assert [fault["what"] for fault in record["faults"]] == ["lose_gps", "battery", "lose_compass", "regain_gps"]
    report = (out / "report.html").read_text()
    assert "its vehicle has a fault" in report
    assert "cannot simulate the loss of its compasses" in report
    assert re.search(r"battery at 25\S* s, lose_compass at 30\S* s: not simulated", report)
    assert record["scenario"]["timeline"][2]["volts"] == 10.4
