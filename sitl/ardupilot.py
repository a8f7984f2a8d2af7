"""Find a binary of ArduPilot SITL, and start it without user interaction.

The command line is that of ArduPilot's SITL (`arducopter --help`, developer documentation "SITL Simulator"). Each
vehicle is instance 0 in its own network namespace, so all vehicles have the same ports. A build of ArduPilot with CAN
needs a multicast route in this namespace. Without the route, it exits with status 1. The directory of a vehicle
contains copies of its parameter files. ArduPilot also writes `eeprom.bin` and `logs/` there. The run directory
therefore documents the parameters of each vehicle.
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sitl._vehicle_state import FirmwareVersion
from sitl.airframes import BINARIES, Airframe, airframe
from sitl.installed import current, install_command, sha256
from sitl.parameters import in_lines
from sitl.setup import USUAL as USUAL_SETUP
from sitl.setup import Debugger, VehicleSetup
from sitl.start_places import autotest
from sitl.vehicle import (
    Home,
    Launch,
    NoBinaryError,
    NoProgramError,
    UnusableBinaryError,
    VehicleError,
    VehicleType,
    check_launch,
)

OWN_DEFAULTS = "vehicle.parm"
ENVIRONMENT = "ARDUPILOT_SITL"  # a directory with binaries, and possibly their default parameters

ANSWER_LIMIT_S = 5.0  # wall time
PATIENT_S = 32_000.0  # simulated seconds; LOG_FILE_TIMEOUT has 16 bits

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
    """A kind of vehicle that runs ArduPilot SITL: an executable, its files of default parameters, and its settings.

    `defaults` are the parameter files next to the executable. `missing` are the names of parameter files that the frame
    needs but that do not exist.
    """

    binary: Path
    defaults: tuple[Path, ...] = ()
    vehicle_type: VehicleType = "copter"
    setup: VehicleSetup = USUAL_SETUP
    missing: tuple[str, ...] = ()
    name: str = "ardupilot"

    @property
    def sha256(self) -> str | None:
        """The SHA-256 hash of the binary in hexadecimal, or None if the binary cannot be read."""
        with contextlib.suppress(OSError):
            return sha256(self.binary)
        return None

    @property
    def frame(self) -> str:
        """ArduPilot's name of the frame."""
        return self._airframe.model

    @property
    def _airframe(self) -> Airframe:
        return airframe(self.setup.frame, self.vehicle_type)

    @property
    def uses_udp(self) -> bool:
        """True: an ArduPilot binary with CAN support sends itself multicast datagrams."""
        return True

    @property
    def lack(self) -> str | None:
        """A sentence about missing default parameters, without which a vehicle may refuse to arm. None if no file is
        missing.
        """
        if not self.missing:
            return None
        files = " and ".join(self.missing)
        return f"it flew without default parameters: put ArduPilot's {files} beside {self.binary}"

    @classmethod
    def find(
        cls,
        binary: Path | None,
        environ: Mapping[str, str],
        vehicle_type: VehicleType = "copter",
        setup: VehicleSetup = USUAL_SETUP,
    ) -> ArduPilot:
        """Return `binary` if it is given. Otherwise return the first suitable binary in ARDUPILOT_SITL, on PATH, or in
        the cache.

        Raises UnusableBinaryError if the binary cannot be used, and NoBinaryError if none is found.
        """
        program = airframe(setup.frame, vehicle_type).program
        if binary is not None:
            return cls._checked(binary, "the scenario", vehicle_type, setup)
        if named := environ.get(ENVIRONMENT):
            directory = Path(named)
            if not directory.is_dir():
                raise UnusableBinaryError(
                    f"{ENVIRONMENT} is {named}, which is not a directory: set it to the directory that holds {program}"
                )
            present = [name for name in BINARIES.values() if (directory / name).exists()]
            if (directory / program).exists() or not present:  # a directory without binaries is a mistake of the user
                return cls._checked(directory / program, ENVIRONMENT, vehicle_type, setup)
        if on_path := shutil.which(program, path=environ.get("PATH", "")):
            return cls._checked(Path(on_path), "PATH", vehicle_type, setup)
        installed = current(vehicle_type, environ)
        if installed and installed.binary.name == program:
            return cls._checked(installed.binary, "the cache", vehicle_type, setup)
        ways = (
            f"run {install_command(vehicle_type)}, {WAY_OUT}"
            if program == BINARIES[vehicle_type]
            else f"put {program} into the directory that {ENVIRONMENT} names, or leave out frame {setup.frame}"
        )
        raise NoBinaryError(
            f"no ArduPilot {vehicle_type}: the scenario names none, {ENVIRONMENT} "
            f"{'has none' if named else 'is not set'}, no {program} is on PATH, and none is installed; {ways}"
        )

    @classmethod
    def _checked(cls, binary: Path, source: str, vehicle_type: VehicleType, setup: VehicleSetup) -> ArduPilot:
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
        defaults = {name: default_parameters(binary, name) for name in airframe(setup.frame, vehicle_type).defaults}
        missing = tuple(name for name, path in defaults.items() if path is None)
        found = tuple(path for path in defaults.values() if path is not None)
        return cls(binary.absolute(), found, vehicle_type, setup, missing)

    def check(self) -> None:
        """Raise VehicleError if the binary or this machine does not support the settings of the vehicle."""
        if self.setup.frame is not None:
            if self.missing:
                files, many = " and ".join(self.missing), len(self.missing) > 1
                raise UnusableBinaryError(
                    f"frame {self.setup.frame} needs ArduPilot's default parameters {files}, which "
                    f"{'are' if many else 'is'} not beside {self.binary}: copy "
                    f"{'them' if many else 'it'} there from Tools/autotest of its source tree"
                )
            self._check_model(self.setup.frame)
        if self.setup.debugger is not None and shutil.which(self.setup.debugger) is None:
            raise NoProgramError(f"no {self.setup.debugger} is on PATH: install it, or leave out `debugger`")

    def _check_model(self, frame: str) -> None:
        """Raise VehicleError if the binary does not offer the frame. An older binary lacks some frames. If the user
        requested such a frame, the binary would simulate another frame whose name has the same beginning.
        """
        offered = models(self.binary)
        words = self.frame.lower().split("-")
        names = {"-".join(words[:count]) for count in range(1, len(words) + 1)}
        if offered and names.isdisjoint(name.lower() for name in offered):
            raise UnusableBinaryError(f"{self.binary} has no frame {frame!r}: it offers {', '.join(offered)}")

    def launch(self, sysid: int, home: Home, speedup: float, directory: Path) -> Launch:
        """Write the parameters of the vehicle to `directory`, and return the command. Raises VehicleError."""
        check_launch(sysid, home, speedup)
        # names instead of paths, because a path may contain a comma, which separates the files
        files = [path.name for path in self.defaults]
        try:
            for path in self.defaults:
                shutil.copyfile(path, directory / path.name)
            (directory / OWN_DEFAULTS).write_text(
                _own_defaults(sysid) + in_lines({**self._logging(), **self.parameters})
            )
        except OSError as error:
            raise VehicleError(f"vehicle {sysid}: cannot write its parameters into {directory}: {error}") from None
        return Launch(
            [
                *self._bounded(),
                *_DEBUGGERS.get(self.setup.debugger, ()),
                str(self.binary),
                *("--model", self.frame),
                *("--home", str(home)),
                *("-I", "0"),
                *("--defaults", ",".join([*files, OWN_DEFAULTS])),
                *("--speedup", f"{speedup:g}"),
                *("--serial0", "tcp:0"),  # by default, ArduPilot starts nothing before a client connects
                *self.setup.arguments,
            ]
        )

    @property
    def parameters(self) -> Mapping[str, float]:
        return self.setup.parameters

    def _logging(self) -> dict[str, float]:
        match self.setup.log_mib:
            case None:
                return {}
            case 0:
                return {"LOG_BACKEND_TYPE": 0.0}
            case _:
                return {"LOG_FILE_TIMEOUT": PATIENT_S}

    def _bounded(self) -> list[str]:
        """The beginning of a command line that limits the size of each file that ArduPilot writes.

        The limit is the maximum size of the log. When a log reaches the limit, ArduPilot behaves as if the disk were
        slow, and stops writing. After LOG_FILE_TIMEOUT seconds, ArduPilot would start another log. `ulimit -f` counts
        blocks of 512 bytes (POSIX).
        """
        if not self.setup.log_mib:
            return []
        return ["sh", "-c", f"trap '' XFSZ; ulimit -f {self.setup.log_mib * 2048}; exec \"$@\"", "sh"]


_DEBUGGERS: dict[Debugger | None, tuple[str, ...]] = {
    "gdb": (
        *("gdb", "-q", "-nx", "-batch", "-return-child-result", "-ex", "set pagination off"),
        *("-ex", "handle SIGXFSZ SIGPIPE nostop noprint pass", "-ex", "run"),
        *("-ex", "thread apply all backtrace", "--args"),
    ),
    "valgrind": ("valgrind", "--log-file=valgrind.log", "--soname-synonyms=somalloc=nouserintercepts"),
}
"""Debugger -> the beginning of its command line. If the vehicle crashes, gdb prints the stack of each thread to the
output of the vehicle.
"""


def models(binary: Path) -> list[str]:
    """Return the names of the frames that a binary lists when it is started without a frame. The result may be
    empty.
    """
    try:
        said = subprocess.run(
            [binary], stdin=subprocess.DEVNULL, capture_output=True, timeout=ANSWER_LIMIT_S, check=False, cwd="/"
        ).stdout.decode("utf-8", "replace")
    except (OSError, subprocess.TimeoutExpired):
        return []
    _, found, listed = said.partition("Options are:")
    return [line.strip() for line in listed.splitlines() if re.fullmatch(r"  [\w+.-]+", line)] if found else []


def build_of(binary: Path) -> FirmwareVersion | None:
    """Return the version and the commit that a binary contains and prints at its start. Return None if it contains
    none.
    """
    try:
        with binary.open("rb") as file:
            found = _BUILD.search(file.read(MAX_BINARY_BYTES))
    except OSError:
        return None
    return FirmwareVersion(found[1].decode(), found[2].decode()) if found else None


_BUILD = re.compile(rb"Ardu(?:Copter|Plane|Rover) V(\d[\w.-]{0,30}) \(([0-9a-f]{7,12})\)", re.ASCII)
MAX_BINARY_BYTES = 200_000_000  # a binary with debugging information has 80 MB


def default_parameters(binary: Path, name: str) -> Path | None:
    """Return a file of default parameters in ArduPilot's source tree or next to the binary. Return None if there is no
    such file.
    """
    for directory in autotest(binary.resolve().parent):
        for path in (directory / name, directory / "default_params" / name, directory / "models" / name):
            if path.is_file():
                return path
    return None


def _own_defaults(sysid: int) -> str:
    """Return parameters that set the system ID, under the old and the new name. ArduPilot ignores unknown
    parameters.
    """
    return f"SYSID_THISMAV {sysid}\nMAV_SYSID {sysid}\n"


def _not_a_program(head: bytes) -> str | None:
    """Return the reason why a file is not a usable binary. The argument contains the first bytes of the file. Return
    None if the file may be usable.
    """
    if not head:
        return "is empty"
    if head.startswith(b"#!"):  # a script of the user that starts a binary
        return None
    if not head.startswith(b"\x7fELF") or len(head) < 20:
        return "is not a program"
    machine = int.from_bytes(head[18:20], "little" if head[5] == 1 else "big")
    here = platform.machine()
    if here in _ELF_MACHINES and machine not in _ELF_MACHINES[here]:
        return f"is for another processor ({_ELF_NAMES.get(machine, f'ELF machine {machine}')}, this is {here})"
    return None
