"""Gathers exports, and what is known of where their events come from."""

from dataclasses import dataclass, field

from harness.archive.archive import RunArchive
from harness.archive.block_names import name_blocks
from harness.archive.exports import SUFFIX, Export
from harness.archive.record import AgentRecord, RunRecord
from harness.errors import ExportError, RunDirectoryError
from harness.play.backends import in_virtual_time


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


def read(archive: RunArchive) -> Logbook:
    """The logbook of an archive. Raises RunDirectoryError if it has no exports at all."""
    exports = archive.exports
    if not exports.by_agent and not exports.errors:
        why = f"holds no exports (*{SUFFIX}): no agent of this run left its chain"
        raise RunDirectoryError(f"{archive.directory}: {why}")
    record = archive.origin
    absent = sorted({*record.roster} - {*exports.by_agent})
    return Logbook(
        exports.by_agent,
        name_blocks(exports.by_agent),
        telemetry=logged_telemetry(record),
        absent={agent_id: _absent(agent_id, record.agents.get(str(agent_id))) for agent_id in absent},
        errors=[*archive.record_problems, *exports.errors],
    )


def logged_telemetry(record: RunRecord) -> bool:
    """Events are random where no vehicle flies; those of exports that came without a run are taken for telemetry."""
    asked = record.scenario
    if asked is None:
        return True
    return asked.events.source == "mavlink" and asked.vehicles.kind != "none" and not in_virtual_time(record.backend)


def _absent(agent_id: int, agent: AgentRecord | None) -> str:
    why = f" ({agent.outcome})" if agent is not None and agent.outcome != "exported" else ""
    return f"agent {agent_id} has no export here{why}"
