"""Gathers exports, and what is known of where their events come from."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from harness.archive.block_names import name_blocks
from harness.archive.exports import RUN_FILE, SUFFIX, Export, export_files, read_exports
from harness.archive.record import AgentRecord
from harness.checker.evidence import MAX_RECORD_BYTES
from harness.errors import ExportError, RunDirectoryError


class _Events(BaseModel):
    source: str


class _Vehicles(BaseModel):
    kind: str | None


class _Scenario(BaseModel):
    events: _Events
    vehicles: _Vehicles


class _Run(BaseModel):
    """The part of run.json that says who flew, and what was logged."""

    model_config = ConfigDict(extra="ignore")

    backend: str
    roster: list[int]
    scenario: _Scenario
    agents: dict[str, AgentRecord] = {}

    @property
    def logged_telemetry(self) -> bool:
        """Events are random where no vehicle flies."""
        scenario = self.scenario
        return self.backend != "sim" and scenario.events.source == "mavlink" and scenario.vehicles.kind != "none"


@dataclass
class Logbook:
    """Exports by agent; `names` of their blocks; `errors`, a sentence for each file that could not be used.

    `telemetry`: events are those of the source `mavlink`. Exports that came without a run are taken for such.
    `absent`: a sentence for each agent of the mission that has no export here.
    """

    exports: dict[int, Export]
    names: dict[str, str]
    telemetry: bool = True
    absent: dict[int, str] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)

    def name(self, block_hash: str) -> str:
        return self.names.get(block_hash, block_hash[:12])

    def only(self, agent_id: int) -> "Logbook":
        """The logbook with one agent's export; blocks keep their names. Raises ExportError if there is none."""
        if agent_id in self.exports:
            return Logbook({agent_id: self.exports[agent_id]}, self.names, self.telemetry, errors=self.errors)
        known = (
            f"exports here are of agents {', '.join(map(str, self.exports))}" if self.exports else "nor of any other"
        )
        raise ExportError(f"{self.absent.get(agent_id, f'there is no export of agent {agent_id}')}; {known}")


def read(paths: Iterable[Path]) -> Logbook:
    """The logbook in run directories, in directories of exports, or in exports from anywhere.

    Raises RunDirectoryError if a path does not exist, or nothing at all is there.
    """
    paths = list(paths)
    files = export_files(paths)
    if not files:
        raise RunDirectoryError(f"{paths[0]}: holds no exports (*{SUFFIX}): no agent of this run left its chain")
    exports = read_exports(files)
    logbook = Logbook(exports.by_agent, name_blocks(exports.by_agent), errors=exports.errors)
    records = dict.fromkeys(directory / RUN_FILE for path in files for directory in (path.parent.parent, path.parent))
    run = next((run for path in records if (run := _run(path)) is not None), None)
    if run is not None:
        logbook.telemetry = run.logged_telemetry
        logbook.absent = {
            agent_id: _absent(agent_id, run.agents.get(str(agent_id)))
            for agent_id in run.roster
            if agent_id not in exports.by_agent
        }
    return logbook


def _run(path: Path) -> _Run | None:
    """None if there is no record, or none that tells."""
    try:
        return _Run.model_validate_json(path.read_bytes()) if path.stat().st_size <= MAX_RECORD_BYTES else None
    except (OSError, ValueError):
        return None


def _absent(agent_id: int, record: AgentRecord | None) -> str:
    why = f" ({record.outcome})" if record is not None and record.outcome != "exported" else ""
    return f"agent {agent_id} has no export here{why}"
