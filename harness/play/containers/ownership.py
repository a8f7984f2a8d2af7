"""Choose names and labels for containers, and remove containers that earlier runs left behind.

A run belongs to the process that carries it out, as long as this process exists. Process IDs are reused, so a process
is identified by boot ID, process ID and start time.
"""

import hashlib
import os
import re
from dataclasses import dataclass, field
from pathlib import Path

import docker.errors

from harness.play.containers.docker_engine import DockerEngine, DockerError

RUN = "ucp-harness.run.run"
VEHICLE = "ucp-harness.vehicle"
ROLE = "ucp-harness.role"
OWNER = "ucp-harness.owner"
PROJECT = "ucp-harness"
"""Label of images of this project."""

_START_TIME = 19  # index of field 22, counted after the command's name, in /proc/PID/stat (proc_pid_stat(5))


def run_name(directory: Path) -> str:
    """Return a container name for the run in this directory. The same directory always gives the same name."""
    digest = hashlib.sha256(os.fsencode(directory)).hexdigest()[:6]
    words = re.sub(r"[^A-Za-z0-9_.]+", "-", directory.name).strip("-_.")[:40]
    return f"ucp-{words}-{digest}" if words else f"ucp-{digest}"


def labels(run: str, vehicle: int, role: str) -> dict[str, str]:
    return {RUN: run, VEHICLE: str(vehicle), ROLE: role, OWNER: this_process()}


def this_process() -> str:
    """Return text that identifies this process: boot ID, process ID and start time."""
    return f"{_boot()} {os.getpid()} {_start_time(os.getpid())}"


def is_alive(owner: str) -> bool:
    """Return true if the process that owns a container still exists. The label of the container identifies this
    process. Return false for an invalid label.
    """
    match owner.split():
        case [boot, pid, started] if pid.isdecimal():
            return boot == _boot() and started == _start_time(int(pid))
    return False


def _boot() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def _start_time(pid: int) -> str | None:
    """Return the start time of a process in clock ticks since boot. Return None if the process has ended."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None
    fields = stat[stat.rindex(")") + 2 :].split()  # a command's name may contain spaces and brackets
    return None if fields[0] in "ZX" else fields[_START_TIME]


@dataclass
class CleanupResult:
    """The names of the removed containers, and of the containers that active runs still use."""

    removed: list[str] = field(default_factory=list)
    still: list[str] = field(default_factory=list)


def clean(engine: DockerEngine) -> CleanupResult:
    """Remove the containers of all ended runs. Containers of active runs stay. Raises DockerError."""
    cleaned = CleanupResult()
    for container in engine.do("list containers", engine.api.containers, all=True, filters={"label": RUN}):
        name = container["Names"][0].removeprefix("/")
        if is_alive(container["Labels"].get(OWNER, "")):
            cleaned.still.append(name)
        else:
            remove(engine, container["Id"], name)
            cleaned.removed.append(name)
    return cleaned


def remove(engine: DockerEngine, identity: str, name: str) -> None:
    """Kill a container and remove it with its volumes. Raises DockerError."""
    try:
        engine.do(f"remove {name}", engine.api.remove_container, identity, v=True, force=True)
    except docker.errors.APIError as error:
        if error.status_code not in (404, 409):  # the container is gone, or is being removed
            raise DockerError(f"the container {name} cannot be removed: {error.explanation}") from None
