"""Print the logbook of a swarm: all events in its chains, as text, JSON, GeoJSON and KML.

`read` reads the exports, `logbook_text` prints chain by chain, and `positions` makes tracks for maps.
The checker judges whether the chains are correct.

`EventData` decodes the event data of blocks, and decrypts them if the key is known. In a secured mission, agents may
encrypt event data for the depot. Only the depot's key decrypts them.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from harness.archive.archive import RunArchive
from harness.archive.exports import SUFFIX, Export, ExportedBlock, name_blocks
from harness.archive.history import LATEST_S
from harness.archive.run_record import AgentRecord, RunRecord
from harness.errors import ExportError, RunDirectoryError
from harness.play.backends import in_virtual_time
from ucp.events import LoggableEvent, MalformedEventsError, decode_events
from ucp.sealed import sealed_to

if TYPE_CHECKING:
    from ucp.secure.sealing import Depot

__all__ = ["Logbook", "read"]


class SealedError(MalformedEventsError):
    """An error: the event data of a block are encrypted, and no known key decrypts them. The message completes a
    sentence about the block.
    """


@dataclass(frozen=True)
class EventData:
    """A decoder for the event data of one mission. `sealed` is true if the data are encrypted. `depot` contains the key
    of the depot, or is None if the key is unknown.
    """

    sealed: bool = False
    depot: "Depot | None" = None

    @property
    def is_closed(self) -> bool:
        """True if the data are encrypted and the key is unknown."""
        return self.sealed and self.depot is None

    @classmethod
    def of(cls, exports: Iterable[Export], depot: "Depot | None" = None) -> "EventData":
        """Return the decoder for the mission of these exports.

        Raises ExportError if `depot` is given, but the mission encrypts its data for another depot or does not encrypt
        them.
        """
        inception = next((export.inception.data for export in exports), b"")
        key = sealed_to(inception)
        if depot is not None and key != depot.public_key:
            why = (
                "no event data is sealed in this mission"
                if key is None
                else "the event data of this mission is sealed to another depot"
            )
            raise ExportError(
                f"the depot key opens no event data here: {why}; leave out --depot-key, or give another key"
            )
        return cls(key is not None, depot)

    def of_block(self, block: ExportedBlock) -> bytes:
        """Return the decrypted event data of a block (Section 3.1). Raises SealedError if the key is unknown
        or wrong.
        """
        return self.opened(block.event_bytes, block.agent_id, block.timestamp_us)

    def opened(self, event_data: bytes, agent_id: int, timestamp_us: int) -> bytes:
        """Decrypt these event data, and return them. `agent_id` and `timestamp_us` belong to the block that contains
        the data.

        Raises SealedError.
        """
        if not self.sealed:
            return event_data
        if self.depot is None:
            raise SealedError("sealed to the depot")
        from ucp.secure.sealing import NotOpenedError

        try:
            return self.depot.open(event_data, agent_id, timestamp_us)
        except NotOpenedError as error:
            raise SealedError(str(error)) from None

    def events(self, block: ExportedBlock) -> list[LoggableEvent]:
        """Return the events in a block. The oldest is first. Raises SealedError, or MalformedEventsError for damaged
        data.
        """
        return decode_events(self.of_block(block))


@dataclass
class Logbook:
    """The chain exports of a swarm, with the facts that are needed to print them."""

    exports: dict[int, Export]
    """The chain export of each agent, by agent ID."""
    names: dict[str, str]
    """The name of each block, by block hash."""
    telemetry: bool = True
    """True if the events come from the source `mavlink`, or if the exports do not belong to a run."""
    absent: dict[int, str] = field(default_factory=dict)
    """A sentence about each agent of the mission that has no export, by agent ID."""
    errors: list[str] = field(default_factory=list)
    """A sentence for each unusable file."""
    event_data: EventData = field(default_factory=EventData)
    """The reader of the events in blocks."""
    epoch_us: int | None = None
    """The timestamp of mission second 0 in microseconds, or None if it is unknown."""

    def name(self, block_hash: str) -> str:
        return self.names.get(block_hash, block_hash[:12])

    def mission_s(self, timestamp_us: int) -> float | None:
        """Return the mission second of a timestamp. Return None for the inception block, or if the start of the mission
        is unknown.
        """
        mission_s = None if self.epoch_us is None else (timestamp_us - self.epoch_us) / 1e6
        return mission_s if mission_s is not None and abs(mission_s) <= LATEST_S else None

    def only(self, agent_id: int) -> "Logbook":
        """Return a logbook that contains only the export of this agent. The blocks keep their names. Raises ExportError
        if the agent has no export.
        """
        if agent_id in self.exports:
            return replace(self, exports={agent_id: self.exports[agent_id]}, absent={})
        known = (
            f"exports here are of agents {', '.join(map(str, self.exports))}" if self.exports else "nor of any other"
        )
        raise ExportError(f"{self.absent.get(agent_id, f'the export of agent {agent_id} is missing')}; {known}")


def read(archive: RunArchive, depot: "Depot | None" = None) -> Logbook:
    """Return the logbook of an archive. `depot` decrypts encrypted events.

    Raises RunDirectoryError if the archive contains no exports. Raises ExportError if the given depot cannot decrypt
    any events.
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
    """Return true if the events of the run are telemetry of vehicles. In a run without vehicles, events are random. If
    there is no run.json, the events are assumed to be telemetry.
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
