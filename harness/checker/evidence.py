"""What the checker looks at: exports, traces where there are any, and what the run's record says of the network."""

from dataclasses import dataclass, field
from functools import cached_property

from harness.archive.archive import RunArchive
from harness.archive.block_names import name_blocks
from harness.archive.exports import Export
from harness.archive.record import AgentRecord, JudgedRecord
from harness.archive.traces import Trace
from harness.checker.replay import Replayed, replay


@dataclass
class Evidence:
    """`record` is the run's `run.json`, None for exports that came without one.

    `before_final_reconcile` are the exports as the mission left them, if a final reconcile followed.
    """

    exports: dict[int, Export]
    traces: dict[int, Trace] = field(default_factory=dict)
    record: JudgedRecord | None = None
    errors: list[str] = field(default_factory=list)
    before_final_reconcile: dict[int, Export] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.names = name_blocks(self.exports)

    def name(self, block_hash: str) -> str:
        return self.names.get(block_hash, block_hash[:12])

    @cached_property
    def replayed(self) -> Replayed:
        """What the traces show of what agents held after each step."""
        return replay(self.traces, self.name)

    @property
    def roster(self) -> list[int] | None:
        """All agents of the mission, as far as a run's record or a trace tells."""
        if self.record is not None:
            return self.record.roster
        for trace in self.traces.values():
            return sorted(trace.header.roster)
        return None

    @property
    def missing(self) -> list[int]:
        """Living agents of the mission whose export is not here."""
        return [agent for agent in self.roster or [] if agent not in self.exports and not self.was_killed(agent)]

    def was_killed(self, agent_id: int) -> bool:
        """Whether the scenario killed the agent for good, and with it all that it held."""
        agent = self._recorded(agent_id)
        return agent is not None and agent.outcome == "killed"

    def was_restarted(self, agent_id: int) -> bool:
        """Whether the scenario killed and restarted the agent: its export knows its last life only."""
        agent = self._recorded(agent_id)
        return agent is not None and agent.restarts > 0

    def _recorded(self, agent_id: int) -> AgentRecord | None:
        return self.record.agents.get(str(agent_id)) if self.record else None

    def was_paused(self, agent_id: int, from_s: float, until_s: float) -> bool:
        """Whether the scenario had the agent stand still at any time between the two."""
        since: float | None = None
        for fault in self.record.faults if self.record else ():
            if agent_id not in (fault.agents or ()):
                continue
            if fault.kind.stands_still:
                since = fault.at_s
            elif since is not None:
                if since <= until_s and fault.at_s >= from_s:
                    return True
                since = None
        return since is not None and since <= until_s

    @property
    def ended_at_s(self) -> float | None:
        """When the run ended, in mission seconds; None if it is not on record."""
        return self.record.mission_s if self.record else None

    @property
    def connected_since_s(self) -> float | None:
        """Mission time since when every agent has heard every other without loss; None if not, or not on record."""
        since: float | None = None
        for state in self.record.network if self.record else ():
            if not state.fully_connected:
                since = None
            elif since is None:
                since = state.at_s
        return since

    @property
    def network_at_end(self) -> str | None:
        """The conditions at the end of the run, in words; None if not on record."""
        return self.record.network[-1].detail if self.record and self.record.network else None

    def completed_blocks(self) -> dict[str, int]:
        """Hash -> agent of every block known to have been completed."""
        owners = {block: agent_id for agent_id, export in self.exports.items() for block in export.completed}
        for name, agent in self.record.agents.items() if self.record else ():
            owners.update(dict.fromkeys(agent.completed_before, int(name)))
        for agent_id, trace in self.traces.items():
            owners.update(dict.fromkeys(trace.completed(), agent_id))
        return owners


def gather(archive: RunArchive) -> Evidence:
    """All that an archive has of it."""
    problems = list(archive.problems)
    if archive.record_error is not None:
        problems[0] += "; the exports are checked without it"
    return Evidence(archive.exports.by_agent, archive.traces, archive.record, problems, archive.before_final_reconcile)
