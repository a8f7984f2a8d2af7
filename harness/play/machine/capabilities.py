"""What this machine can do for us: facts and ways out. `ucp-harness doctor` prints them."""

import os
import platform
import sys
from dataclasses import asdict, dataclass
from typing import Any

from netem import lab_doctor, uml
from netem.errors import UmlError
from sitl.ardupilot import ArduPilot
from sitl.vehicle import VehicleError


@dataclass(frozen=True)
class Requirement:
    """What runs need of a machine, and what of it is there; `way_out` is what would mend it.

    Without what is `needed` there is no run.
    """

    name: str
    ok: bool
    needed: bool
    detail: str
    way_out: str | None = None

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def examine() -> list[Requirement]:
    """Look at this machine; builds and removes a small lab to find out what the kernel allows."""
    python = Requirement(
        "Python", sys.version_info >= (3, 11), True, platform.python_version(), "install Python 3.11 or newer"
    )
    lab = [
        Requirement(requirement.name, requirement.ok, requirement.needed, requirement.detail, requirement.way_out)
        for requirement in lab_doctor.examine()
    ]
    return [python, *lab, _user_mode_linux(), _docker(), _ardupilot()]


def _user_mode_linux() -> Requirement:
    use = "--kernel uml: all of netem, in a process without privileges"
    if uml.inside():
        return Requirement("User Mode Linux", True, False, "this is it")
    try:
        return Requirement("User Mode Linux", True, False, f"{uml.examine()}; for {use}")
    except UmlError as error:
        return Requirement("User Mode Linux", False, False, str(error), f"with it there is {use}")


def _docker() -> Requirement:
    from harness.play.containers.container_preflight import require_root
    from harness.play.containers.docker_engine import DockerError, Engine

    use = "--backend docker: vehicles and agents in containers"
    try:
        engine = Engine.connect()
        version = engine.api.version()["Version"]
        engine.close()
        require_root()
    except DockerError as error:
        return Requirement("Docker", False, False, str(error), f"with it there is {use}")
    return Requirement("Docker", True, False, f"{version}, for {use}")


def _ardupilot() -> Requirement:
    try:
        ardupilot = ArduPilot.find(None, os.environ)
    except VehicleError as error:
        return Requirement("ArduPilot SITL", False, False, f"{error}", "without it runs use the embedded vehicle")
    if ardupilot.defaults is None:
        way_out = "put ArduPilot's default parameters, copter.parm, beside it: without them it may refuse to arm"
        return Requirement("ArduPilot SITL", False, False, f"{ardupilot.binary}, without copter.parm", way_out)
    return Requirement("ArduPilot SITL", True, False, str(ardupilot.binary))
