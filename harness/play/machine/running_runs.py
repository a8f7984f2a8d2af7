"""Find the active runs on this machine by looking at the working directories of processes.

A vehicle works in RUN/vehicles/ID. An agent works in RUN/agents, and in a later incarnation in RUN/agents/ID-NUMBER;
its last argument is ID.mission.json. Both programs run in the network namespace of their vehicle, either directly or in
a container. The harness therefore needs no list of active runs.
"""

import contextlib
import re
from collections import defaultdict
from pathlib import Path

from harness.archive.exports import RUN_FILE

_PLACE = re.compile(r"(?P<run>.+)/(?:agents|vehicles/(?P<vehicle>[1-9][0-9]{0,4})(?:-[0-9]+)?|agents/[1-9][0-9-]*)")
_MISSION = re.compile(rb"(?:.*/)?([1-9][0-9]{0,4})\.mission\.json")


def running(proc: Path = Path("/proc")) -> dict[Path, dict[int, int]]:
    """Return the active run directories. For each run directory, return the ID of one process for each vehicle."""
    runs: defaultdict[Path, dict[int, int]] = defaultdict(dict)
    for entry in proc.iterdir():
        if not entry.name.isdigit():
            continue
        with contextlib.suppress(OSError):  # gone meanwhile, or another user's
            place = _PLACE.fullmatch(str((entry / "cwd").readlink()))
            if place and Path(place["run"], RUN_FILE).is_file() and _in_another_network(entry, proc):
                vehicle = place["vehicle"] or _agent_of(entry)
                if vehicle is not None:
                    runs[Path(place["run"])].setdefault(int(vehicle), int(entry.name))
    return {run: dict(sorted(vehicles.items())) for run, vehicles in sorted(runs.items())}


def _agent_of(entry: Path) -> bytes | None:
    """Return the agent ID in the file name of the process's mission file. Return None if the process has no mission
    file.
    """
    *_, last = (entry / "cmdline").read_bytes().removesuffix(b"\0").split(b"\0")
    named = _MISSION.fullmatch(last)
    return named[1] if named else None


def _in_another_network(entry: Path, proc: Path) -> bool:
    """Return true if the process uses a different network than this process. This check excludes a user's shell whose
    working directory is in the run directory.
    """
    return (entry / "ns/net").readlink() != (proc / "self/ns/net").readlink()


def enter_command(pid: int) -> list[str]:
    """Return the nsenter(1) command that runs a further command in the network and user namespace of a process."""
    target, ours = Path(f"/proc/{pid}/ns/user"), Path("/proc/self/ns/user")
    user = ["--user", "--preserve-credentials"] if target.readlink() != ours.readlink() else []
    return ["nsenter", f"--target={pid}", *user, "--net", "--"]
