"""Test how ArduPilot is found and started. Small programs take the place of its binary."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path

import pytest

from sitl.ardupilot import ArduPilot
from sitl.vehicle import NoBinaryError, UnusableBinaryError, VehicleError, VehicleKind
from tests.sitl.flying import HOME

SCRIPT = '#!/bin/sh\necho "$@"\nexit 1\n'


def program(path: Path, content: str | bytes = SCRIPT, mode: int = 0o755) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    path.chmod(mode)
    return path


def test_scenario_precedes_environment_and_path(tmp_path: Path) -> None:
    named = program(tmp_path / "named" / "my-copter")
    in_environment = program(tmp_path / "environment" / "arducopter")
    on_path = program(tmp_path / "path" / "arducopter")
    both = {"ARDUPILOT_SITL": str(in_environment.parent), "PATH": str(on_path.parent)}
    assert ArduPilot.find(named, both).binary == named
    assert ArduPilot.find(None, both).binary == in_environment
    assert ArduPilot.find(None, {"PATH": str(on_path.parent)}).binary == on_path


def test_missing_binary_raises_no_binary_error(tmp_path: Path) -> None:
    with pytest.raises(NoBinaryError, match="ARDUPILOT_SITL is not set"):
        ArduPilot.find(None, {"PATH": str(tmp_path)})


def test_wrong_directory_in_environment_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UnusableBinaryError, match=r"ARDUPILOT_SITL is .* not a directory"):
        ArduPilot.find(None, {"ARDUPILOT_SITL": str(tmp_path / "gone"), "PATH": ""})
    with pytest.raises(UnusableBinaryError, match="does not exist"):
        ArduPilot.find(None, {"ARDUPILOT_SITL": str(tmp_path), "PATH": ""})


def elf(machine: int) -> bytes:
    return b"\x7fELF\x02\x01\x01" + bytes(9) + b"\x02\x00" + machine.to_bytes(2, "little") + bytes(44)


@pytest.mark.parametrize(
    ("content", "mode", "problem"),
    [
        (SCRIPT, 0o644, r"not executable: run chmod \+x"),
        ("", 0o755, "is empty"),
        ("FRAME_CLASS 1\n", 0o755, "is not a program"),
        (b"\x7fELF", 0o755, "is not a program"),
        (elf(8), 0o755, "another processor"),
    ],
)
def test_each_unusable_binary_has_its_own_message(
    content: str | bytes, mode: int, problem: str, tmp_path: Path
) -> None:
    binary = program(tmp_path / "arducopter", content, mode)
    with pytest.raises(UnusableBinaryError, match=problem) as error:
        ArduPilot.find(binary, {})
    assert str(binary) in str(error.value)


def test_missing_binary_and_directory_have_different_messages(tmp_path: Path) -> None:
    with pytest.raises(UnusableBinaryError, match="does not exist"):
        ArduPilot.find(tmp_path / "arducopter", {})
    with pytest.raises(UnusableBinaryError, match="is a directory"):
        ArduPilot.find(tmp_path, {})


def test_binary_for_another_processor_names_both_processors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    with pytest.raises(UnusableBinaryError, match="aarch64, this is x86_64"):
        ArduPilot.find(program(tmp_path / "arducopter", elf(183)), {})
    assert ArduPilot.find(program(tmp_path / "arducopter", elf(62)), {}).binary.name == "arducopter"


def test_command_line_fits_arducopter(tmp_path: Path) -> None:
    binary = program(tmp_path / "arducopter")
    directory = tmp_path / "with, comma"
    directory.mkdir()
    kind: VehicleKind = ArduPilot.find(binary, {})
    launch = kind.launch(7, HOME, 20.0, directory)
    assert launch.argv[0] == str(binary)
    said = subprocess.run(launch.argv, cwd=directory, capture_output=True, text=True, check=False)
    assert said.stdout.strip() == (
        "--model + --home -35.3632620,149.1652370,584.00,270.0 -I 0 "
        "--defaults vehicle.parm --speedup 20 --serial0 tcp:0"
    )
    assert (launch.pilot_port, launch.agent_port) == (5760, 5762)


def test_system_id_is_set_under_both_names(tmp_path: Path) -> None:
    ArduPilot(program(tmp_path / "arducopter")).launch(7, HOME, 1.0, tmp_path)
    assert (tmp_path / "vehicle.parm").read_text().splitlines() == ["SYSID_THISMAV 7", "MAV_SYSID 7"]


def test_own_parameters_override_those_of_the_binary(tmp_path: Path) -> None:
    binary = program(tmp_path / "bin" / "arducopter")
    (binary.parent / "copter.parm").write_text("FRAME_CLASS 1\n")
    launch = ArduPilot.find(binary, {}).launch(7, HOME, 1.0, tmp_path)
    assert launch.argv[launch.argv.index("--defaults") + 1] == "copter.parm,vehicle.parm"
    assert (tmp_path / "copter.parm").read_text() == "FRAME_CLASS 1\n"


def test_unwritable_directory_is_named(tmp_path: Path) -> None:
    with pytest.raises(VehicleError, match="cannot write its parameters into"):
        ArduPilot(program(tmp_path / "arducopter")).launch(7, HOME, 1.0, tmp_path / "gone")


def test_each_type_has_its_binary_parameters_and_model(tmp_path: Path) -> None:
    for name in ("arducopter", "arduplane", "ardurover"):
        program(tmp_path / "bin" / name)
        (tmp_path / "bin" / "plane.parm").write_text("AIRSPEED_CRUISE 22\n")
    environ = {"ARDUPILOT_SITL": str(tmp_path / "bin")}
    plane, rover = ArduPilot.find(None, environ, "plane"), ArduPilot.find(None, environ, "rover")
    assert (plane.binary.name, rover.binary.name) == ("arduplane", "ardurover")
    flown = plane.launch(7, HOME, 1.0, tmp_path).argv
    assert flown[flown.index("--model") + 1] == "plane"
    assert flown[flown.index("--defaults") + 1] == "plane.parm,vehicle.parm"
    driven = rover.launch(8, HOME, 1.0, tmp_path).argv
    assert driven[driven.index("--model") + 1] == "rover"
    assert driven[driven.index("--defaults") + 1] == "vehicle.parm"


def test_binaries_of_other_types_raise_no_binary_error(tmp_path: Path) -> None:
    program(tmp_path / "arducopter")
    with pytest.raises(NoBinaryError, match=r"no ArduPilot plane: .* ARDUPILOT_SITL has none, no arduplane"):
        ArduPilot.find(None, {"ARDUPILOT_SITL": str(tmp_path), "PATH": ""}, "plane")
