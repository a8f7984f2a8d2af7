"""The run directory: all that a run leaves, and all that anything after the run needs.

run.json            scenario as resolved, seed, versions, backend, engine, verdict
agents/7.*          mission file, chain export, trace and log of agent 7; its store, if it keeps one
agents/7-2/         those of its second life, if it was killed and began again; export and trace are above, too
vehicles/7/         the vehicle's own files, its output, telemetry.tlog; of its second life in vehicles/7-2/
capture/7.pcapng    every frame that vehicle 7 sent and every one that reached it, if asked for (netem.capture)
network.jsonl       every change of conditions as the kernel applied it, and its counters at the end
tracks.jsonl        where the vehicles were, in metres north, east and up from the middle of the field
replay.yaml         the scenario with the changes that the user made by hand (harness.play.interventions)
rogue.jsonl         what the rogue node has sent, if the timeline injects; rogue.log has what it had to say
lag.jsonl           how late the machine woke programs, and how busy each agent was (harness.archive.lag)
lab.log             what the lab itself had to say
report.html  report.md  junit.xml  chains.svg
"""

import json
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.archive import traces
from harness.archive.connectivity import NETWORK_FILE
from harness.archive.exports import BEFORE_FINAL_RECONCILE, RUN_FILE, SUFFIX, export_paths
from harness.archive.lag import LAG_FILE
from harness.archive.run_listing import RUNS
from harness.archive.run_record import RunRecord
from harness.archive.tracks import TRACKS_FILE
from harness.errors import MachineError, RunDirectoryError
from netem.radio import Place
from ucp.agent_files import write_json_atomically

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys

ROGUE_FILE = "rogue.jsonl"
PUBLIC_KEYS_FILE = "public.json"
ROGUE_CONTROL = "rogue.control"


class RunDirectory:
    """The directory of a run while it is played: where everybody works, and what is taken down as it happens.

    Raises RunDirectoryError if it cannot be made, or holds anything already. What is written into it raises OSError
    where the disk refuses, unless it says otherwise.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        self.agents = self.path / "agents"
        self.vehicles = self.path / "vehicles"
        self.lab_log = self.path / "lab.log"
        self.rogue_log = self.path / "rogue.log"
        self.lag = self.path / LAG_FILE
        self.keys: Mapping[int, Path] = {}
        """Where each vehicle has its keys while it is played: elsewhere, for nothing secret is kept here."""
        claim(path, self.agents, self.vehicles)

    def vehicle(self, vehicle_id: int, incarnation: int = 1) -> Path:
        """The directory in which a vehicle works; each that takes the place of a lost one has its own."""
        path = self.vehicles / (str(vehicle_id) if incarnation == 1 else f"{vehicle_id}-{incarnation}")
        path.mkdir(exist_ok=True)
        return path

    def agent(self, agent_id: int, incarnation: int = 1) -> Path:
        """The directory in which an agent works; each life of it has its own."""
        path = self.agents if incarnation == 1 else self.agents / f"{agent_id}-{incarnation}"
        path.mkdir(exist_ok=True)
        return path

    def capture(self) -> Path:
        """The directory for captures. Raises OSError."""
        path = self.path / "capture"
        path.mkdir()
        return path

    def write_mission(self, directory: Path, agent_id: int, mission: Mapping[str, Any]) -> Path:
        """Write what ucp/contract/CONTRACT.md tells an agent at its start, and return the file."""
        path = directory / f"{agent_id}.mission.json"
        write_json_atomically(path, dict(mission))
        return path

    def copy_export(self, agent_id: int, directory: Path) -> None:
        """Copy the export of a later life, if there is one, to where the checker looks for it."""
        export = directory / f"{agent_id}{SUFFIX}"
        if directory != self.agents and export.exists():
            shutil.copyfile(export, self.agents / export.name)

    def append_trace(self, agent_id: int, directory: Path, copied_bytes: int = 0) -> int:
        """Append what is new in the trace of a later life, after `brought` bytes, to the agent's; how many bytes it is.

        Half a last line, which the agent was killed over or still writes, is left out.
        """
        later = directory / f"{agent_id}{traces.SUFFIX}"
        if not later.exists():
            return 0
        with later.open("rb") as file:
            file.seek(copied_bytes)
            added = file.read()
        added = added[: added.rfind(b"\n") + 1]
        with (self.agents / later.name).open("a+b") as trace:
            trace.seek(0)
            trace.truncate(trace.read().rfind(b"\n") + 1)
            trace.write(added)
        return len(added)

    def keep_exports_before_final_reconcile(self) -> None:
        """Copy the exports as they stand: how the mission left the chains, before anybody put them in order."""
        kept = self.path / BEFORE_FINAL_RECONCILE
        kept.mkdir()
        for path in export_paths(self.path):
            shutil.copyfile(path, kept / path.name)

    def write_public_keys(self, keys: "PublicKeys") -> None:
        """What everybody may know of a secured mission's keys: by it signatures are checked. Raises OSError."""
        write_json_atomically(self.path / PUBLIC_KEYS_FILE, keys.to_json())

    def append_network(self, record: Mapping[str, Any]) -> None:
        """A change of the network or a fault of agents, at `at_s` mission seconds, as it was made."""
        self._append(NETWORK_FILE, record)

    def append_injected(self, record: Mapping[str, Any]) -> None:
        """A datagram of the rogue node, or several that are only counted, at `at_s` mission seconds."""
        self._append(ROGUE_FILE, record)

    def append_tracks(self, at_s: float, places: Mapping[int, Place]) -> None:
        """Where vehicles were at `at_s` mission seconds."""
        tracks = {str(vehicle): place.to_json() for vehicle, place in places.items()}
        self._append(TRACKS_FILE, {"at_s": round(at_s, 3), "places": tracks})

    def _append(self, name: str, record: Mapping[str, Any]) -> None:
        with (self.path / name).open("a", encoding="utf-8") as file:
            file.write(json.dumps(record, separators=(",", ":")) + "\n")

    def write_record(self, record: RunRecord) -> None:
        """Write run.json whole or not at all. Raises MachineError if the disk is full."""
        try:
            write_json_atomically(self.path / RUN_FILE, record.to_json())
        except OSError as error:
            raise MachineError(
                f"{self.path / RUN_FILE} cannot be written: {error.strerror}; the other files of the run are "
                f"complete: judge them with `ucp-harness check {self.path}`"
            ) from None


def claim(directory: Path, *inner: Path) -> None:
    """Make the directory, or take an empty one, and directories in it.

    Raises RunDirectoryError if it cannot be made, or holds anything already.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if any(directory.iterdir()):
            raise RunDirectoryError(
                f"{directory} is not empty: choose another --out; existing files are not overwritten"
            )
        for path in inner:
            path.mkdir()
    except (FileExistsError, NotADirectoryError):
        raise RunDirectoryError(f"{directory} is not a directory: choose another --out") from None
    except OSError as error:
        raise RunDirectoryError(f"{directory} cannot be created: {error.strerror}; choose another --out") from None


def default_path(name: str) -> Path:
    """`runs/<scenario's name>-<local time>` under the current directory; a number is added if it exists."""
    words = "".join(character if character.isalnum() else " " for character in name).split()
    base = RUNS / f"{'_'.join(words).lower()[:60] or 'run'}-{time.strftime('%Y%m%d-%H%M%S')}"
    candidate, number = base, 2
    while candidate.exists():
        candidate, number = base.with_name(f"{base.name}-{number}"), number + 1
    return candidate
