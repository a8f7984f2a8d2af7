"""Read the chain exports of a swarm, and find out whether their events are telemetry."""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from harness.archive.archive import RunArchive
from harness.archive.event_data import EventData
from harness.archive.exports import SUFFIX, Export, name_blocks
from harness.archive.history import LATEST_S
from harness.archive.run_record import AgentRecord, RunRecord
from harness.errors import ExportError, RunDirectoryError
from harness.play.backends import in_virtual_time

if TYPE_CHECKING:
    from ucp.secure.sealing import Depot


@dataclass
class Logbook:
    """The chain exports of a swarm, by agent, with the facts that are needed to print them.

    names: names of the blocks by hash. telemetry: whether the events come from the source `mavlink`, which is assumed
    for exports without a run. absent: a sentence for each agent of the mission without an export. errors: a sentence
    for each unusable file. event_data: the reader of events in blocks. epoch_us: the timestamp of mission second 0,
    None if unknown.
    """

    exports: dict[int, Export]
    names: dict[str, str]
    telemetry: bool = True
    absent: dict[int, str] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    event_data: EventData = field(default_factory=EventData)
    epoch_us: int | None = None

    def name(self, block_hash: str) -> str:
        return self.names.get(block_hash, block_hash[:12])

    def mission_s(self, timestamp_us: int) -> float | None:
        """Return the mission second of a timestamp. Return None for the inception block, or if the start of the mission
        is unknown.
        """
        mission_s = None if self.epoch_us is None else (timestamp_us - self.epoch_us) / 1e6
        return mission_s if mission_s is not None and abs(mission_s) <= LATEST_S else None

    def only(self, agent_id: int) -> "Logbook":
        """Return a logbook that contains only the export of this agent.

        Blocks keep their names. Raises ExportError if there is no export.
        """
        if agent_id in self.exports:
            return replace(self, exports={agent_id: self.exports[agent_id]}, absent={})
        known = (
            f"exports here are of agents {', '.join(map(str, self.exports))}" if self.exports else "nor of any other"
        )
        raise ExportError(f"{self.absent.get(agent_id, f'the export of agent {agent_id} is missing')}; {known}")


def read(archive: RunArchive, depot: "Depot | None" = None) -> Logbook:
    """Return the logbook of an archive. `depot` decrypts encrypted events.

    Raises RunDirectoryError if the archive has no exports, and ExportError if no events are encrypted for this depot.
    """
    exports = archive.exports
    if not exports.by_agent and not exports.errors:
        reason = f"holds no exports (*{SUFFIX}), so there are no chains"
        raise RunDirectoryError(f"{archive.directory}: {reason}")
    record = archive.origin
    absent = sorted({*record.roster} - {*exports.by_agent})
    return Logbook(
        exports.by_agent,
        name_blocks(exports.by_agent),
        telemetry=logged_telemetry(record),
        absent={agent_id: _absent(agent_id, record.agents.get(str(agent_id))) for agent_id in absent},
        errors=[*archive.record_problems, *exports.errors],
        event_data=EventData.of(exports.by_agent.values(), depot),
        epoch_us=archive.epoch_us,
    )


def logged_telemetry(record: RunRecord) -> bool:
    """Return true if the events are telemetry of vehicles.

    In a run without vehicles, events are random. Without run.json, they are assumed to be telemetry.
    """
    scenario = record.scenario
    if scenario is None:
        return True
    return (
        scenario.events.source == "mavlink" and scenario.vehicles.kind != "none" and not in_virtual_time(record.backend)
    )


def _absent(agent_id: int, agent: AgentRecord | None) -> str:
    reason = f" ({agent.outcome})" if agent is not None and agent.outcome != "exported" else ""
    return f"agent {agent_id} has no export here{reason}"
