"""Names and labels of containers, and the removal of containers that a run left behind.

A run is its orchestrator's as long as that process lives. A process is known by its number and the moment it started,
in one boot of this machine: numbers are used again.
"""

import hashlib
import os
import re
from dataclasses import dataclass, field
from pathlib import Path

import docker.errors

from harness.play.containers.docker_engine import DockerError, Engine

RUN = "ucp-harness.run.run"
VEHICLE = "ucp-harness.vehicle"
ROLE = "ucp-harness.role"
OWNER = "ucp-harness.owner"
PROJECT = "ucp-harness"
"""On images: which of the project's they are."""

_START_TIME = 19  # of the fields after the command's name in /proc/PID/stat (proc_pid_stat(5): field 22)


def run_name(directory: Path) -> str:
    """A name for the run in this directory, as container names may be: the same directory, the same name."""
    digest = hashlib.sha256(os.fsencode(directory)).hexdigest()[:6]
    words = re.sub(r"[^A-Za-z0-9_.]+", "-", directory.name).strip("-_.")[:40]
    return f"ucp-{words}-{digest}" if words else f"ucp-{digest}"


def labels(run: str, vehicle: int, role: str) -> dict[str, str]:
    return {RUN: run, VEHICLE: str(vehicle), ROLE: role, OWNER: this_process()}


def this_process() -> str:
    """This process as an owner: boot, number and start time."""
    return f"{_boot()} {os.getpid()} {_started(os.getpid())}"


def lives(owner: str) -> bool:
    """Whether the process that a label names is still there; a label that makes no sense is nobody's."""
    match owner.split():
        case [boot, pid, started] if pid.isdecimal():
            return boot == _boot() and started == _started(int(pid))
    return False


def _boot() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def _started(pid: int) -> str | None:
    """When it started, in clock ticks since boot; None of a process that has ended, reaped or not."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None
    fields = stat[stat.rindex(")") + 2 :].split()  # a command's name may hold spaces and brackets
    return None if fields[0] in "ZX" else fields[_START_TIME]


@dataclass
class Cleaned:
    """Names of containers: what was `removed`, and what is `still` of runs that are going on."""

    removed: list[str] = field(default_factory=list)
    still: list[str] = field(default_factory=list)


def clean(engine: Engine) -> Cleaned:
    """Remove every container of a run that is over, and nothing else. Raises DockerError."""
    cleaned = Cleaned()
    for container in engine.do("list containers", engine.api.containers, all=True, filters={"label": RUN}):
        name = container["Names"][0].removeprefix("/")
        if lives(container["Labels"].get(OWNER, "")):
            cleaned.still.append(name)
        else:
            remove(engine, container["Id"], name)
            cleaned.removed.append(name)
    return cleaned


def remove(engine: Engine, identity: str, name: str) -> None:
    """Kill and remove a container, and what it wrote. Raises DockerError."""
    try:
        engine.do(f"remove {name}", engine.api.remove_container, identity, v=True, force=True)
    except docker.errors.APIError as error:
        if error.status_code not in (404, 409):  # it is gone, or somebody is at it
            raise DockerError(f"the container {name} cannot be removed: {error.explanation}") from None
