"""Test the settings of vehicles: files of parameters and locations, frames and their defaults, debuggers and logs."""

from __future__ import annotations

import math
import struct
import subprocess
from pathlib import Path

import pytest

from sitl import parameters, start_places
from sitl.airframes import airframe
from sitl.ardupilot import ArduPilot
from sitl.embedded import Embedded
from sitl.setup import VehicleSetup
from sitl.vehicle import NoBinaryError, NoProgramError, VehicleError, VehicleType
from tests.sitl.flying import HOME
from tests.sitl.test_ardupilot import program

LISTS_ITS_MODELS = """#!/bin/sh
if [ $# = 0 ]; then
    printf 'You must specify a vehicle model.  Options are:\\n  quadplane\\n  +\\n  hexa\\n  heli\\n  plane\\n'
    exit 1
fi
echo "$@"; ulimit -f
"""


def written(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_parameters_of_ground_stations_are_read_without_system_id(tmp_path: Path) -> None:
    path = written(
        tmp_path / "x.parm", "# mine\nWPNAV_SPEED 500\nSIM_WIND_SPD,4.5 // gusty\n1\t1\tRTL_ALT\t30\t6\nMAV_SYSID 9\n\n"
    )
    assert parameters.read(path) == {"WPNAV_SPEED": 500, "SIM_WIND_SPD": 4.5, "RTL_ALT": 30}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("WPNAV_SPEED\n", "line 1: 'WPNAV_SPEED' is not a parameter: write NAME VALUE"),
        ("A 1\nwpnav 2\n", "line 2: 'wpnav 2' is not a parameter"),
        ("A nan\n", "is not a parameter"),
        ("A 1e39\n", "is not a parameter"),
        ("".join(f"P{number} 1\n" for number in range(5001)), "more than 5000"),
        ("A" * 1_000_001, "larger than"),
    ],
)
def test_invalid_parameter_file_is_refused_with_its_line(text: str, problem: str, tmp_path: Path) -> None:
    with pytest.raises(VehicleError, match=problem):
        parameters.read(written(tmp_path / "x.parm", text))


def test_each_unreadable_path_has_its_own_message(tmp_path: Path) -> None:
    with pytest.raises(VehicleError, match="No such file"):
        parameters.read(tmp_path / "gone.parm")
    with pytest.raises(VehicleError, match="is not a file"):
        parameters.read(tmp_path)
    (tmp_path / "x.parm").write_bytes(b"\xff\xfe")
    with pytest.raises(VehicleError, match="is not a text file"):
        parameters.read(tmp_path / "x.parm")


def test_written_parameters_are_read_back_exactly(tmp_path: Path) -> None:
    floats = [0.0, 1.0, -0.1, 1e-9, math.pi, 16777217.0, 3.4028234e38]
    values = {f"P{number}": struct.unpack("<f", struct.pack("<f", value))[0] for number, value in enumerate(floats)}
    again = parameters.read(written(tmp_path / "x.parm", parameters.in_lines(values)))
    assert [struct.pack("<f", again[name]) for name in values] == [struct.pack("<f", values[name]) for name in values]
    assert parameters.in_lines({"A": values["P2"]}) == "A -0.1\n"


def test_unknown_parameter_is_named_with_a_similar_one() -> None:
    known = ["SIM_WIND_SPD", "SIM_WIND_DIR", "RTL_ALT"]
    assert parameters.unknown(["RTL_ALT"], known) is None
    assert parameters.unknown(["SIM_WIND_SPED"], known) == "no parameter SIM_WIND_SPED: did you mean SIM_WIND_SPD?"
    assert (parameters.unknown(["ZZ", "YY"], known) or "").startswith("no parameter YY (nor 1 more): its whole list")


def test_location_files_are_searched_in_order(tmp_path: Path) -> None:
    mine = written(tmp_path / "config" / "ardupilot" / "locations.txt", "#N=x\nAVC=40.07,-105.2,1583.7,366 # field\n")
    environ = {"XDG_CONFIG_DIR": str(mine.parents[1])}
    assert start_places.named("AVC", tmp_path, environ).heading_deg == 6
    written(tmp_path / "locations.txt", "AVC=1,2,3,4\n")
    assert start_places.named("AVC", tmp_path, environ).lat_deg == 1
    with pytest.raises(VehicleError, match=r"no such location in .*: did you mean AVC\?"):
        start_places.named("AVD", tmp_path, environ)
    with pytest.raises(VehicleError, match="no file of named locations found: searched"):
        start_places.named("AVC", tmp_path / "none", {"HOME": "/nowhere"})
    tree = tmp_path / "ardupilot"
    written(tree / "Tools" / "autotest" / "locations.txt", "CMAC=-35.3,149.1,584,353\n")
    assert (
        start_places.named("CMAC", None, {"HOME": "/nowhere", "ARDUPILOT_SITL": str(tree / "build/sitl/bin")}).alt_m
        == 584
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("here\n", "line 1: 'here' has no = in it"),
        ("AVC=1,2,3\n", "is not LATITUDE,LONGITUDE,ALTITUDE,HEADING"),
        ("AVC=91,2,3,4\n", "line 1: home latitude 91.0 is not on Earth"),
    ],
)
def test_invalid_location_is_refused_with_its_line(text: str, problem: str, tmp_path: Path) -> None:
    written(tmp_path / "locations.txt", text)
    with pytest.raises(VehicleError, match=problem):
        start_places.named("AVC", tmp_path, {})


def test_swarm_offsets_are_assigned_by_instance(tmp_path: Path) -> None:
    path = written(tmp_path / "swarm.txt", "#instance=East,North,Up,Heading\n1=20,30,4,90\n2=-20,0,0\n1=9,9,9,9\n")
    offsets = start_places.swarm(path)
    assert offsets.keys() == {1, 2}
    home = offsets[1].of(HOME)
    assert HOME.metres_to(home.lat_deg, home.lon_deg, home.alt_m) == pytest.approx((30, 20, 4))
    assert home.heading_deg == 90 and offsets[2].of(HOME).heading_deg == HOME.heading_deg
    for text, problem in (
        ("x=1,2,3\n", "is not an instance"),
        ("1=1,2\n", "is not EAST,NORTH"),
        ("#\n", "has no offsets"),
    ):
        with pytest.raises(VehicleError, match=problem):
            start_places.swarm(written(tmp_path / "swarm.txt", text))


@pytest.mark.parametrize(
    ("frame", "vehicle_type", "model", "defaults"),
    [
        ("hexa-cwx", "copter", "hexa-cwx", ["copter.parm", "copter-hexa.parm", "copter-hexa-cwx.parm"]),
        ("boat", "rover", "motorboat", ["rover.parm", "motorboat.parm"]),
        ("quadplane-tilt", "plane", "quadplane-tilt", ["quadplane.parm", "quadplane-tilt.parm"]),
    ],
)
def test_frame_has_its_default_parameter_files(
    frame: str, vehicle_type: VehicleType, model: str, defaults: list[str]
) -> None:
    known = airframe(frame, vehicle_type)
    assert (known.vehicle_type, known.model, list(known.defaults)) == (vehicle_type, model, defaults)


@pytest.mark.parametrize(
    ("frame", "vehicle_type", "advice"),
    [
        ("hexacopter", "copter", "did you mean hexa[?]"),
        ("octocopter", "copter", "did you mean octa[?]"),
        ("xfoo", "copter", "did you mean X[?]"),
        ("x", "copter", "did you mean X[?]"),
        ("plane-vtial", "plane", "did you mean plane[?]"),
        ("hovercraft", "rover", "use one of rover, rover-skid"),
    ],
)
def test_unknown_frame_is_refused_with_the_nearest_one(frame: str, vehicle_type: VehicleType, advice: str) -> None:
    with pytest.raises(VehicleError, match=f"a {vehicle_type} has no frame '{frame}': {advice}"):
        airframe(frame, vehicle_type)


def test_parameter_files_are_copied_in_order_with_the_users_last(tmp_path: Path) -> None:
    binary = program(tmp_path / "bin" / "arducopter", LISTS_ITS_MODELS)
    setup = VehicleSetup("hexa", {"RTL_ALT": 30.0}, ("--rate", "400"))
    lacking = ArduPilot.find(binary, {}, setup=setup)
    with pytest.raises(VehicleError, match=r"frame hexa needs .* copter.parm and copter-hexa.parm, which are not"):
        lacking.check()
    written(tmp_path / "bin" / "copter.parm", "FRAME_CLASS 1\n")
    written(tmp_path / "bin" / "default_params" / "copter-hexa.parm", "FRAME_CLASS 2\n")
    kind = ArduPilot.find(binary, {}, setup=setup)
    kind.check()
    (tmp_path / "7").mkdir()
    argv = kind.launch(7, HOME, 1.0, tmp_path / "7").argv
    assert argv[argv.index("--model") + 1] == "hexa"
    assert argv[argv.index("--defaults") + 1] == "copter.parm,copter-hexa.parm,vehicle.parm"
    assert argv[-2:] == ["--rate", "400"]
    assert (tmp_path / "7" / "vehicle.parm").read_text().splitlines()[-1] == "RTL_ALT 30"


def test_missing_frame_and_missing_debugger_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    binary = program(tmp_path / "arducopter", LISTS_ITS_MODELS)
    for name in ("copter.parm", "copter-octa.parm"):
        written(tmp_path / name, "")
    with pytest.raises(VehicleError, match=r"has no frame 'octa': it offers quadplane, \+, hexa, heli, plane"):
        ArduPilot.find(binary, {}, setup=VehicleSetup("octa")).check()
    with pytest.raises(NoBinaryError, match="no arducopter-heli is on PATH"):
        ArduPilot.find(None, {"ARDUPILOT_SITL": str(tmp_path), "PATH": ""}, setup=VehicleSetup("heli"))
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(NoProgramError, match="no valgrind is on PATH: install it, or leave out `debugger`"):
        ArduPilot.find(binary, {}, setup=VehicleSetup(debugger="valgrind")).check()


def test_log_can_be_disabled_or_limited(tmp_path: Path) -> None:
    binary = program(tmp_path / "arducopter", LISTS_ITS_MODELS)
    without = ArduPilot(binary, setup=VehicleSetup(log_mib=0)).launch(7, HOME, 1.0, tmp_path)
    assert without.argv[0] == str(binary) and "LOG_BACKEND_TYPE 0\n" in (tmp_path / "vehicle.parm").read_text()
    bounded = ArduPilot(binary, setup=VehicleSetup(log_mib=3)).launch(7, HOME, 1.0, tmp_path)
    said = subprocess.run(bounded.argv, capture_output=True, text=True, check=True).stdout.splitlines()
    assert said[-1] == str(3 * 2048)
    ArduPilot(binary, setup=VehicleSetup(parameters={"LOG_BACKEND_TYPE": 2.0}, log_mib=0)).launch(
        7, HOME, 1.0, tmp_path
    )
    assert (tmp_path / "vehicle.parm").read_text().endswith("\nLOG_BACKEND_TYPE 2\n")


def test_embedded_vehicle_refuses_features_of_ardupilot() -> None:
    Embedded("plane", VehicleSetup("plane", {"TKOFF_ALT": 30.0})).check()
    with pytest.raises(VehicleError, match="embedded vehicles have no wind: fly ArduPilot, or leave it out"):
        Embedded("plane", VehicleSetup(parameters={"SIM_WIND_SPD": 3.0})).check()
    with pytest.raises(VehicleError, match="embedded vehicles have no frame quadplane and no debugger: fly ArduPilot"):
        Embedded("plane", VehicleSetup("quadplane", debugger="gdb")).check()
