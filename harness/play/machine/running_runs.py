"""Which runs go on at this machine, and who lives where in them: from the processes' own working directories.

A run needs no register for that: a vehicle works in RUN/vehicles/ID, an agent in RUN/agents and in a later life in
RUN/agents/ID-LIFE, with ID.mission.json as its last argument; and either is in the network namespace of its vehicle, as
a process as in a container.
"""

import contextlib
import re
from collections import defaultdict
from pathlib import Path

from harness.archive.exports import RUN_FILE

_PLACE = re.compile(r"(?P<run>.+)/(?:agents|vehicles/(?P<vehicle>[1-9][0-9]{0,4})(?:-[0-9]+)?|agents/[1-9][0-9-]*)")
_MISSION = re.compile(rb"(?:.*/)?([1-9][0-9]{0,4})\.mission\.json")


def running(proc: Path = Path("/proc")) -> dict[Path, dict[int, int]]:
    """Of each run directory whose programs we may see: vehicle -> the process ID of one that lives in it."""
    runs: defaultdict[Path, dict[int, int]] = defaultdict(dict)
    for entry in proc.iterdir():
        if not entry.name.isdigit():
            continue
        with contextlib.suppress(OSError):  # gone meanwhile, or another user's
            place = _PLACE.fullmatch(str((entry / "cwd").readlink()))
            if place and Path(place["run"], RUN_FILE).is_file() and _is_elsewhere(entry, proc):
                vehicle = place["vehicle"] or _of_its_mission(entry)
                if vehicle is not None:
                    runs[Path(place["run"])].setdefault(int(vehicle), int(entry.name))
    return {run: dict(sorted(vehicles.items())) for run, vehicles in sorted(runs.items())}


def _of_its_mission(entry: Path) -> bytes | None:
    """Whose mission file an agent was started with; None if with none."""
    *_, last = (entry / "cmdline").read_bytes().removesuffix(b"\0").split(b"\0")
    named = _MISSION.fullmatch(last)
    return named[1] if named else None


def _is_elsewhere(entry: Path, proc: Path) -> bool:
    """Whether it is in another network than ours: somebody who looks into its directory in a shell is not."""
    return (entry / "ns/net").readlink() != (proc / "self/ns/net").readlink()


def way_into(pid: int) -> list[str]:
    """What runs a command in the network of a process, and in its user namespace where that is another (nsenter(1))."""
    target, ours = Path(f"/proc/{pid}/ns/user"), Path("/proc/self/ns/user")
    user = ["--user", "--preserve-credentials"] if target.readlink() != ours.readlink() else []
    return ["nsenter", f"--target={pid}", *user, "--net", "--"]
