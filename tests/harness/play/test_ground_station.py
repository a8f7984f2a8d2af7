"""Test runs with a ground station that sees all vehicles and commands one of them."""

import asyncio
import json
import os
import threading
import time
from pathlib import Path

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from harness.play.simulation import _station_tracks
from harness.scenario import Scenario
from sitl.modes import MODES
from sitl.track import track
from tests.harness.command import harness, write_scenario

DEADLINE_S = 60.0


class GroundStation(threading.Thread):
    """A ground station on a free port. It records which vehicles it sees, and sends vehicle 2 home when the vehicle
    flies.
    """

    def __init__(self, deadline_s: float = DEADLINE_S) -> None:
        super().__init__(daemon=True)
        self._deadline_s = deadline_s
        self._link = mavutil.mavlink_connection("udpin:127.0.0.1:0", dialect="ardupilotmega")
        self.port = self._link.port.getsockname()[1]
        self.seen: set[int] = set()
        self.over = threading.Event()

    def run(self) -> None:
        commanded, deadline = False, time.monotonic() + self._deadline_s
        while not self.over.is_set() and time.monotonic() < deadline:
            message = self._link.recv_match(type=["HEARTBEAT", "GLOBAL_POSITION_INT"], blocking=True, timeout=0.2)
            if message is None:
                continue
            if message.get_srcSystem() not in self.seen:  # ArduPilot sends positions only on request
                self.seen.add(message.get_srcSystem())
                self._link.mav.request_data_stream_send(message.get_srcSystem(), 1, mavlink.MAV_DATA_STREAM_ALL, 4, 1)
            flies = message.get_type() == "GLOBAL_POSITION_INT" and message.relative_alt > 19_000
            if flies and message.get_srcSystem() == 2 and not commanded:
                commanded = True
                mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, MODES["copter"]["RTL"]
                self._link.mav.command_long_send(2, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, *mode, 0, 0, 0, 0, 0)
        self._link.close()


@pytest.mark.lab
def test_operator_sees_all_vehicles_and_commands_one(tmp_path: Path) -> None:
    ground = GroundStation()
    ground.start()
    scenario = write_scenario(tmp_path, vehicles={"kind": "embedded"}, duration_s=200, speedup=50)
    out = tmp_path / "run"
    done = harness("run", scenario, "--out", out, "--gcs", f"127.0.0.1:{ground.port}")
    ground.over.set()
    ground.join()
    assert done.returncode == 0, done.stderr
    record = json.loads((out / "run.json").read_text())
    assert ground.seen == {1, 2, 3}
    (command,) = record["ground_station"]["commands"]
    assert (command["vehicles"], command["command"]) == ([2], "MAV_CMD_DO_SET_MODE")
    assert 0 < command["at_s"] < 200
    flown = {vehicle: (it["mode"], it["armed"]) for vehicle, it in record["vehicles"].items()}
    assert flown["2"] == (MODES["copter"]["RTL"], False)
    assert flown["1"] == flown["3"] == (MODES["copter"]["GUIDED"], True)


@pytest.mark.ardupilot
@pytest.mark.parametrize(
    "backend",
    [
        pytest.param(("process",), marks=pytest.mark.lab),
        pytest.param(("docker", "--image-from-host"), marks=pytest.mark.docker),
    ],
)
def test_operator_flies_a_real_copter_under_a_debugger(backend: tuple[str, ...], tmp_path: Path) -> None:
    """The test takes two minutes, because a copter cannot be armed in its first 46 s."""
    if "ARDUPILOT_SITL" not in os.environ:
        pytest.skip("no ArduPilot: set ARDUPILOT_SITL to the directory that holds an arducopter")
    ground = GroundStation(deadline_s=200)
    ground.start()
    vehicles = {"kind": "ardupilot", "each": {1: {"debugger": "gdb"}}}
    scenario = write_scenario(tmp_path, agents=2, vehicles=vehicles, duration_s=60, speedup=1)
    out = tmp_path / "run"
    gcs = ("--gcs", f"127.0.0.1:{ground.port}")
    done = harness("run", scenario, "--out", out, *gcs, "--backend", *backend)
    ground.over.set()
    ground.join()
    assert done.returncode == 0, done.stdout + done.stderr
    record = json.loads((out / "run.json").read_text())
    assert ground.seen >= {1, 2}
    (command,) = record["ground_station"]["commands"]
    assert (command["vehicles"], command["command"]) == ([2], "MAV_CMD_DO_SET_MODE")
    assert record["vehicles"]["2"]["mode"] == MODES["copter"]["RTL"]
    assert min(vehicle["real_time_factor"] for vehicle in record["vehicles"].values()) > 0.95


@pytest.mark.any_user
def test_tracks_in_virtual_time_are_visible_and_refuse_commands(tmp_path: Path) -> None:
    ground = GroundStation()
    ground.start()
    timeline = [{"at_s": 60, "kill": [3]}]
    scenario = write_scenario(tmp_path, vehicles={"types": {3: "plane"}}, timeline=timeline, duration_s=120, speedup=60)
    out = tmp_path / "run"
    done = harness("run", scenario, "--out", out, "--backend", "sim", "--gcs", f"127.0.0.1:{ground.port}")
    ground.over.set()
    ground.join()
    assert done.returncode == 0, done.stderr
    record = json.loads((out / "run.json").read_text())
    assert ground.seen == {1, 2, 3}
    (command,) = record["ground_station"]["commands"]
    assert (command["vehicles"], command["command"]) == ([2], "MAV_CMD_DO_SET_MODE")
    assert "Its commands were refused, because virtual time computes the tracks" in (out / "report.html").read_text()


def test_vehicles_send_heartbeats_while_time_is_paused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_station_tracks, "SHOW_S", 0.0)
    monkeypatch.setattr(_station_tracks, "SILENT_S", 0.0)
    link = mavutil.mavlink_connection("udpin:127.0.0.1:0", dialect="ardupilotmega")
    asked = Scenario.model_validate({"name": "held", "agents": 2, "gcs": f"127.0.0.1:{link.port.getsockname()[1]}"})

    async def show_paused_time() -> None:
        tracks = {vehicle: track("copter", None) for vehicle in (1, 2)}
        shown = await _station_tracks.StationTracks.open(asked, tracks, lambda: 0.0)
        for _ in range(5):
            shown.show(0.0, lost=set())
            await asyncio.sleep(0.01)
        shown.close()

    asyncio.run(show_paused_time())
    heard = [link.recv_match(type="HEARTBEAT", blocking=True, timeout=DEADLINE_S) for _ in range(6)]
    assert {message.get_srcSystem() for message in heard} == {1, 2}
    link.close()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--gcs", "14550"], "a ground station is HOST:PORT, for example 127.0.0.1:14550, not '14550'"),
        (["--gcs", "127.0.0.1:14550", "--kernel", "uml"], "--gcs does not work with --kernel uml"),
        (["--gcs", "127.0.0.1:14550", "--vehicles", "none"], "a ground station needs vehicles, and `vehicles.kind` is"),
        (["--gcs", "255.255.255.255:14550"], "255.255.255.255:14550 cannot be sent (Permission denied)"),
    ],
)
def test_invalid_ground_station_causes_one_sentence(arguments: list[str], sentence: str, tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path, vehicles={"kind": "embedded"})
    done = harness("run", scenario, "--out", tmp_path / "run", *arguments)
    assert done.returncode == 2
    assert not (tmp_path / "run").exists()
    assert sentence in " ".join(done.stderr.split())


@pytest.mark.any_user
def test_unreachable_ground_station_causes_one_sentence(tmp_path: Path) -> None:
    options = ["--out", tmp_path / "run", "--backend", "sim", "--gcs", "255.255.255.255:1"]
    done = harness("run", write_scenario(tmp_path), *options)
    assert done.returncode == 2
    assert not (tmp_path / "run").exists()
    assert "datagrams to the ground station at 255.255.255.255:1 cannot be sent" in " ".join(done.stderr.split())
