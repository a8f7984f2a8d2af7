"""ArduPilot SITL: finding the binary, and starting it so that it flies without anybody holding its hand.

The command line is that of ArduPilot's own SITL (`arducopter --help`, developer documentation "SITL Simulator").
A vehicle is instance 0 in a network namespace of its own, hence always the same ports; builds with CAN want a multicast
route in that namespace, or exit with status 1. The vehicle's directory gets its parameters, copied, beside the
`eeprom.bin` and `logs/` that ArduPilot writes there: what a vehicle flew with stays with the run.
"""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sitl.installed import BINARIES, DEFAULTS, current, install_command
from sitl.vehicle import Home, Launch, NoBinaryError, UnusableBinaryError, VehicleError, VehicleType, check_launch

MODELS: dict[VehicleType, str] = {"copter": "+", "plane": "plane", "rover": "rover"}
OWN_DEFAULTS = "vehicle.parm"
ENVIRONMENT = "ARDUPILOT_SITL"  # a directory that holds binaries and, better, their default parameters

WAY_OUT = "give the path of an ArduPilot SITL binary, or fly embedded vehicles"

# ELF header: e_machine, a u16 at offset 18, by what platform.machine() calls it. A 64-bit machine may run its 32-bit
# sister's programs.
_ELF_MACHINES = {
    "i686": {3: "i686"},
    "x86_64": {62: "x86_64", 3: "i686"},
    "armv7l": {40: "armv7l"},
    "aarch64": {183: "aarch64", 40: "armv7l"},
    "riscv64": {243: "riscv64"},
}
_ELF_NAMES = {number: name for machines in _ELF_MACHINES.values() for number, name in machines.items()}


@dataclass(frozen=True)
class ArduPilot:
    """The `VehicleKind` of real vehicles: an executable and, when it has any beside it, its default parameters."""

    binary: Path
    defaults: Path | None = None
    vehicle_type: VehicleType = "copter"
    name: str = "ardupilot"

    @property
    def lack(self) -> str | None:
        """Without its default parameters a vehicle may refuse to arm."""
        if self.defaults is not None:
            return None
        return f"it flew without default parameters: put ArduPilot's {DEFAULTS[self.vehicle_type]} beside {self.binary}"

    @classmethod
    def find(cls, binary: Path | None, environ: Mapping[str, str], vehicle_type: VehicleType = "copter") -> ArduPilot:
        """The binary that the scenario names, else the type's own in ARDUPILOT_SITL, on PATH, or installed.

        Raises UnusableBinaryError when one is named and will not do, NoBinaryError when none is named or found.
        """
        program = BINARIES[vehicle_type]
        if binary is not None:
            return cls._checked(binary, "the scenario", vehicle_type)
        if named := environ.get(ENVIRONMENT):
            directory = Path(named)
            if not directory.is_dir():
                raise UnusableBinaryError(
                    f"{ENVIRONMENT} is {named}, which is no directory: set it to the directory that holds {program}"
                )
            present = [name for name in BINARIES.values() if (directory / name).exists()]
            if program in present or not present:  # a directory with nothing in it is a mistake
                return cls._checked(directory / program, ENVIRONMENT, vehicle_type)
        if on_path := shutil.which(program, path=environ.get("PATH", "")):
            return cls._checked(Path(on_path), "PATH", vehicle_type)
        if installed := current(vehicle_type, environ):
            return cls._checked(installed.binary, "the cache", vehicle_type)
        raise NoBinaryError(
            f"no ArduPilot {vehicle_type}: the scenario names none, {ENVIRONMENT} "
            f"{'has none' if named else 'is not set'}, no {program} is on PATH, and none is installed; "
            f"run {install_command(vehicle_type)}, {WAY_OUT}"
        )

    @classmethod
    def _checked(cls, binary: Path, source: str, vehicle_type: VehicleType) -> ArduPilot:
        subject = f"the ArduPilot binary {binary} (from {source})"
        try:
            if binary.is_dir():
                raise UnusableBinaryError(
                    f"{subject} is a directory: name the file in it, usually {BINARIES[vehicle_type]}"
                )
            if not binary.exists():
                raise UnusableBinaryError(f"{subject} does not exist: {WAY_OUT}")
            if not binary.is_file():
                raise UnusableBinaryError(f"{subject} is not a file: {WAY_OUT}")
            with binary.open("rb") as file:
                head = file.read(20)
        except OSError as error:
            raise UnusableBinaryError(f"{subject} cannot be read ({error.strerror}): {WAY_OUT}") from None
        if problem := _not_a_program(head):
            raise UnusableBinaryError(f"{subject} {problem}: {WAY_OUT}")
        if not os.access(binary, os.X_OK):
            raise UnusableBinaryError(f"{subject} is not executable: run chmod +x {binary}")
        beside = binary.resolve().parent / DEFAULTS[vehicle_type]
        return cls(binary.absolute(), beside if beside.is_file() else None, vehicle_type)

    def launch(self, sysid: int, home: Home, speedup: float, directory: Path) -> Launch:
        """Write the vehicle's parameters into `directory`. Raises VehicleError."""
        check_launch(sysid, home, speedup)
        # names, not paths: ArduPilot takes a comma in a path for the end of it
        files = [OWN_DEFAULTS]
        try:
            if self.defaults is not None:
                defaults = DEFAULTS[self.vehicle_type]
                shutil.copyfile(self.defaults, directory / defaults)
                files.insert(0, defaults)
            (directory / OWN_DEFAULTS).write_text(_own_defaults(sysid))
        except OSError as error:
            raise VehicleError(f"vehicle {sysid}: cannot write its parameters into {directory}: {error}") from None
        return Launch(
            [
                str(self.binary),
                *("--model", MODELS[self.vehicle_type]),
                *("--home", str(home)),
                *("-I", "0"),
                *("--defaults", ",".join(files)),
                *("--speedup", f"{speedup:g}"),
                *("--serial0", "tcp:0"),  # the default waits for a client before anything runs, the clock included
            ]
        )


def _own_defaults(sysid: int) -> str:
    """Both names of the system ID, before and since 4.7; ArduPilot passes over a parameter that it does not know."""
    return f"SYSID_THISMAV {sysid}\nMAV_SYSID {sysid}\n"


def _not_a_program(head: bytes) -> str | None:
    """What is wrong with a file that begins like this, or None."""
    if not head:
        return "is empty"
    if head.startswith(b"#!"):  # a wrapper of the user's own
        return None
    if not head.startswith(b"\x7fELF") or len(head) < 20:
        return "is not a program"
    machine = int.from_bytes(head[18:20], "little" if head[5] == 1 else "big")
    here = platform.machine()
    if here in _ELF_MACHINES and machine not in _ELF_MACHINES[here]:
        return f"is for another processor ({_ELF_NAMES.get(machine, f'ELF machine {machine}')}, this is {here})"
    return None
