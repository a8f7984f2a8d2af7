"""The run directory: all that a run leaves, and all that anything after the run needs.

run.json            scenario as resolved, seed, versions, backend, engine, verdict
agents/7.*          mission file, chain export, trace and log of agent 7
vehicles/7/         the vehicle's own files, its output, telemetry.tlog
network.jsonl       every change of conditions as the kernel applied it, and its counters at the end
lab.log             what the lab itself had to say
report.html  chains.svg
"""

import json
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from harness.checker.evidence import RUN_FILE
from harness.errors import MachineError, RunDirectoryError
from harness.exports import BEFORE_FINAL_RECONCILE, export_paths
from harness.record import RunRecord
from ucp.files import write_json_atomically


class RunDirectory:
    """Raises RunDirectoryError if it cannot be made, or holds anything already."""

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        self.agents = self.path / "agents"
        self.vehicles = self.path / "vehicles"
        self.lab_log = self.path / "lab.log"
        claim(path, self.agents, self.vehicles)

    def vehicle(self, vehicle_id: int) -> Path:
        path = self.vehicles / str(vehicle_id)
        path.mkdir(exist_ok=True)
        return path

    def write_mission(self, agent_id: int, mission: Mapping[str, Any]) -> Path:
        path = self.agents / f"{agent_id}.mission.json"
        write_json_atomically(path, dict(mission))
        return path

    def keep_exports_before_final_reconcile(self) -> None:
        """Copy the exports as they stand: how the mission left the chains, before anybody put them in order."""
        kept = self.path / BEFORE_FINAL_RECONCILE
        kept.mkdir()
        for path in export_paths(self.path):
            shutil.copyfile(path, kept / path.name)

    def append_network(self, record: Mapping[str, Any]) -> None:
        with (self.path / "network.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(record, separators=(",", ":")) + "\n")

    def write_record(self, record: RunRecord) -> None:
        """Write run.json whole or not at all. Raises MachineError if the disk is full."""
        try:
            write_json_atomically(self.path / RUN_FILE, record.to_json())
        except OSError as error:
            raise MachineError(
                f"{self.path / RUN_FILE} cannot be written: {error.strerror}; what the run left is there, and "
                f"`ucp-harness check {self.path}` judges it"
            ) from None


def claim(directory: Path, *inner: Path) -> None:
    """Make the directory, or take an empty one, and directories in it.

    Raises RunDirectoryError if it cannot be made, or holds anything already.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if any(directory.iterdir()):
            raise RunDirectoryError(f"{directory} is not empty: choose another --out, nothing is overwritten")
        for path in inner:
            path.mkdir()
    except (FileExistsError, NotADirectoryError):
        raise RunDirectoryError(f"{directory} is not a directory: choose another --out") from None
    except OSError as error:
        raise RunDirectoryError(f"{directory} cannot be made: {error.strerror}; choose another --out") from None


def default_path(name: str) -> Path:
    """`runs/<scenario's name>-<local time>` under the current directory; a number is added if it exists."""
    words = "".join(character if character.isalnum() else " " for character in name).split()
    base = Path("runs") / f"{'_'.join(words).lower()[:60] or 'run'}-{time.strftime('%Y%m%d-%H%M%S')}"
    candidate, number = base, 2
    while candidate.exists():
        candidate, number = base.with_name(f"{base.name}-{number}"), number + 1
    return candidate
