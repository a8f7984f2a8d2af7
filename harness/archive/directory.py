"""Create a run directory and write its files. Later commands, such as `check` and `report`, read these files.

run.json            resolved scenario, seed, versions, backend, engine, verdict
agents/7.*          mission file, chain export, trace and log of agent 7, and its store if it keeps one
agents/7-2/         files of its second incarnation after a kill; export and trace are also copied to agents/
vehicles/7/         files of vehicle 7, its output and telemetry.tlog; vehicles/7-2/ is for its replacement
capture/7.pcapng    all frames that vehicle 7 sent or received, if captures were requested (netem.capture)
network.jsonl       each change of conditions as the kernel applied it, and the kernel's counters at the end
tracks.jsonl        positions of the vehicles, in metres north, east and up from the centre of the field
replay.yaml         the scenario with the changes that the user made by hand (harness.play.interventions)
channel.jsonl       each message on a shared channel, and the vehicles that lost it; channel.log is the output of the
                    process that simulates the channel
rogue.jsonl         datagrams that the rogue node sent, if the timeline injects any; rogue.log is its output
lag.jsonl           delays of programs that the machine woke late, and the load of each agent
lab.log             output of the lab
report.html  report.md  junit.xml  chains.svg

`past_runs` lists the run directories in a folder.
"""

import json
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from heapq import nlargest
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.archive.connectivity import NETWORK_FILE
from harness.archive.exports import BEFORE_FINAL_RECONCILE, RUN_FILE, SUFFIX, export_paths
from harness.archive.record_file import read_record
from harness.archive.run_journals import CHANNEL_FILE, LAG_FILE
from harness.archive.run_record import RunRecord
from harness.archive.trace_files import SUFFIX as TRACE_SUFFIX
from harness.archive.trace_files import open_trace
from harness.archive.tracks import TRACKS_FILE
from harness.errors import MachineError, RunDirectoryError
from netem.radio import Place
from ucp.agent_files import end_of_last_line, write_json_atomically

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys


RUNS = Path("runs")
"""Name of the folder for runs that were started without --out."""


@dataclass(frozen=True)
class PastRun:
    """A run directory with its record. `problem` is the reason why the record cannot be read. It is None for a readable
    record.
    """

    path: Path
    record: RunRecord
    problem: str | None

    @property
    def report(self) -> Path:
        return self.path / "report.html"


def past_runs(folder: Path, most: int) -> Iterator[PastRun]:
    """Yield the runs in `folder` whose run.json was written last, at most `most` of them. The newest run is first.

    Raises RunDirectoryError if `folder` is not a folder.
    """
    try:
        written = [(path.stat().st_mtime_ns, path) for path in folder.glob(f"*/{RUN_FILE}")]
    except OSError as error:
        raise RunDirectoryError(f"{folder} cannot be read: {error.strerror}") from None
    if not folder.is_dir():
        raise RunDirectoryError(
            f"{folder} does not exist: `ucp-harness run` creates it; otherwise name the folder of your runs"
        )
    for _, path in nlargest(most, written):
        file = read_record(path)
        yield PastRun(path.parent, file.record, str(file.error) if file.error else None)


ROGUE_FILE = "rogue.jsonl"
PUBLIC_KEYS_FILE = "public.json"
ROGUE_CONTROL = "rogue.control"


class RunDirectory:
    """The directory of a run in progress. Backends create files in it, and the mission appends its records.

    Raises RunDirectoryError if the directory cannot be made or is not empty. A method that writes raises OSError on a
    disk error, or the error that its docstring names.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        self.agents = self.path / "agents"
        self.vehicles = self.path / "vehicles"
        self.lab_log = self.path / "lab.log"
        self.rogue_log = self.path / "rogue.log"
        self.lag = self.path / LAG_FILE
        self.keys: Mapping[int, Path] = {}
        """The directory with the keys of each vehicle during the run. This directory is not inside the run directory,
        because a run directory must not contain secrets.
        """
        self.keys_fingerprint: str | None = None
        """Fingerprint of the public keys in the run directory. None without keys."""
        claim(path, self.agents, self.vehicles)

    def vehicle(self, vehicle_id: int, incarnation: int = 1) -> Path:
        """Create the directory of a vehicle and return its path. A vehicle that replaces a lost vehicle has its own
        directory.
        """
        path = self.vehicles / (str(vehicle_id) if incarnation == 1 else f"{vehicle_id}-{incarnation}")
        path.mkdir(exist_ok=True)
        return path

    def agent(self, agent_id: int, incarnation: int = 1) -> Path:
        """Create a directory for one incarnation of an agent, and return the directory."""
        path = self.agents if incarnation == 1 else self.agents / f"{agent_id}-{incarnation}"
        path.mkdir(exist_ok=True)
        return path

    def capture(self) -> Path:
        """Create the directory for packet captures and return it."""
        path = self.path / "capture"
        path.mkdir()
        return path

    def write_mission(self, directory: Path, agent_id: int, mission: Mapping[str, Any]) -> Path:
        """Write the mission file (ucp/contract/CONTRACT.md), which an agent reads at its start. Return the path of the
        file.
        """
        path = directory / f"{agent_id}.mission.json"
        write_json_atomically(path, dict(mission))
        return path

    def copy_export(self, agent_id: int, directory: Path) -> None:
        """Copy the chain export of a restarted agent to the directory in which the checker expects it."""
        export = directory / f"{agent_id}{SUFFIX}"
        if directory != self.agents and export.exists():
            shutil.copyfile(export, self.agents / export.name)

    def append_trace(self, agent_id: int, directory: Path, copied_bytes: int = 0) -> int:
        """Append the trace of the current incarnation to the complete trace of the agent. Return the number of appended
        bytes.

        The first `copied_bytes` bytes of the incarnation's trace are skipped, because they were appended before. An
        incomplete last line is omitted, because the agent was killed while it wrote the line, or is still writing it.
        """
        later = directory / f"{agent_id}{TRACE_SUFFIX}"
        if not later.exists():
            return 0
        with open_trace(later) as file:
            added = file.read()[copied_bytes:]
        added = added[: added.rfind(b"\n") + 1]
        with (self.agents / later.name).open("a+b") as trace:
            trace.truncate(end_of_last_line(trace))
            trace.write(added)
        return len(added)

    def keep_exports_before_final_reconcile(self) -> None:
        """Copy the current chain exports before the final reconcile changes the chains."""
        kept = self.path / BEFORE_FINAL_RECONCILE
        kept.mkdir()
        for path in export_paths(self.path):
            shutil.copyfile(path, kept / path.name)

    def write_public_keys(self, keys: "PublicKeys") -> None:
        """Write the public keys of a secured mission. The checker uses them to verify signatures."""
        write_json_atomically(self.path / PUBLIC_KEYS_FILE, keys.to_json())
        self.keys_fingerprint = keys.fingerprint

    def append_network(self, record: Mapping[str, Any]) -> None:
        """Append a network change or a fault that happened at mission second `at_s`."""
        self._append(NETWORK_FILE, record)

    def append_injected(self, record: Mapping[str, Any]) -> None:
        """Append an entry about the rogue node at mission second `at_s`. The entry describes one datagram that the
        rogue node sent, or states the number of datagrams.
        """
        self._append(ROGUE_FILE, record)

    def append_channel(self, record: Mapping[str, Any]) -> None:
        """Append the log line of a message on a shared radio channel."""
        self._append(CHANNEL_FILE, record)

    def append_lag(self, agent_id: str, line: bytes) -> None:
        """Append a measurement of the computer of a remote agent. If the computer runs several agents, `agent_id` is
        one of them.
        """
        try:
            measured = json.loads(line)
        except ValueError:
            return
        if isinstance(measured, dict):
            self._append(LAG_FILE, {**measured, "computer_of": agent_id})

    def append_tracks(self, at_s: float, places: Mapping[int, Place]) -> None:
        """Append the positions of vehicles at mission second `at_s`."""
        tracks = {str(vehicle): place.to_json() for vehicle, place in places.items()}
        self._append(TRACKS_FILE, {"at_s": round(at_s, 3), "places": tracks})

    def _append(self, name: str, record: Mapping[str, Any]) -> None:
        with (self.path / name).open("a", encoding="utf-8") as file:
            file.write(json.dumps(record, separators=(",", ":")) + "\n")

    def write_record(self, record: RunRecord) -> None:
        """Write run.json, completely or not at all. Raises MachineError if the disk is full."""
        try:
            write_json_atomically(self.path / RUN_FILE, record.to_json())
        except OSError as error:
            raise MachineError(
                f"{self.path / RUN_FILE} cannot be written: {error.strerror}; the other files of the run are "
                f"complete: judge them with `ucp-harness check {self.path}`"
            ) from None


def claim(directory: Path, *inner: Path) -> None:
    """Create the run directory with the directories `inner` in it, or use an existing empty directory.

    Raises RunDirectoryError if the directory cannot be made or is not empty.
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
    """Return the path `runs/<name of the scenario>-<local time>`. If this path exists, a number is appended."""
    words = "".join(character if character.isalnum() else " " for character in name).split()
    base = RUNS / f"{'_'.join(words).lower()[:60] or 'run'}-{time.strftime('%Y%m%d-%H%M%S')}"
    candidate, number = base, 2
    while candidate.exists():
        candidate, number = base.with_name(f"{base.name}-{number}"), number + 1
    return candidate
