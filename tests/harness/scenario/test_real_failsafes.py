"""Test failsafes of a real ArduCopter. Entries of the timeline cause them."""

import json
import os
from pathlib import Path

import pytest

from sitl.modes import MODES
from tests.harness.command import harness, write_scenario

TIMELINE = [{"at_s": 30, "lose_gcs": [1]}, {"at_s": 31, "lose_rc": [2]}, {"at_s": 32, "breach_fence": [3]}]
PLAN = [{"take_off": 30}, {"go_to": [400, 100]}, {"loiter_s": 300}, {"land": True}]


@pytest.mark.ardupilot
def test_copter_returns_without_station_or_rc_and_outside_the_fence(tmp_path: Path) -> None:
    directory = os.environ.get("ARDUPILOT_SITL")
    if directory is None or not (Path(directory) / "arducopter").exists():
        pytest.skip("no ArduPilot: set ARDUPILOT_SITL to the directory that holds an arducopter")
    written = write_scenario(
        tmp_path,
        duration_s=60,
        speedup=5,
        vehicles={"kind": "ardupilot", "each": {1: {"parameters": {"FS_GCS_ENABLE": 1}}}},
        flight=[{"vehicles": [1, 2, 3], "plan": PLAN}],
        timeline=TIMELINE,
    )
    out = tmp_path / "run"
    done = harness("run", written, "--out", out)
    assert done.returncode == 0, done.stderr
    vehicles = json.loads((out / "run.json").read_text())["vehicles"]
    modes = MODES["copter"]
    assert [vehicles[vehicle]["mode"] for vehicle in ("1", "2")] == [modes["RTL"]] * 2
    assert vehicles["3"]["mode"] in (modes["RTL"], modes["LAND"])
