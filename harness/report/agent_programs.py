"""List the programs that ran as agents in a run. The list is empty if all agents ran the harness's own program."""

import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from harness.archive.run_record import AgentRecord, RunRecord
from harness.report.chain_tree import ranges
from harness.scenario import Scenario


@dataclass(frozen=True)
class AgentProgram:
    """The program that one or more agents ran."""

    agents: tuple[int, ...]
    command: tuple[str, ...] | None
    """The command that starts the program, or None for the harness's own program."""
    version: str | None
    """The version that the agents reported, or None if they reported no version."""

    @property
    def in_words(self) -> str:
        """Describe the program, for example "agent 2 ran ./my_agent --fast (1.4)"."""
        program = "the harness's own" if self.command is None else shlex.join(self.command)
        of_version = "" if self.version is None else f" ({self.version})"
        return f"agent{'s' * (len(self.agents) > 1)} {', '.join(ranges([*self.agents]))} ran {program}{of_version}"

    def to_json(self) -> dict[str, object]:
        return {"agents": self.agents, "command": self.command, "version": self.version}


def programs(record: RunRecord) -> list[AgentProgram]:
    """Return the programs, sorted by the lowest ID of the agents that ran the program. The list is empty if all agents
    ran the harness's own program.
    """
    return [] if record.scenario is None else asked_for(record.scenario, record.agents)


def asked_for(scenario: Scenario, agents: Mapping[str, AgentRecord] = MappingProxyType({})) -> list[AgentProgram]:
    """Return the programs that the agents of a scenario use. If `agents` is given, the result also contains the program
    versions that these agents reported in a run.
    """
    if not scenario.foreign:
        return []
    alike: dict[tuple[tuple[str, ...] | None, str | None], list[int]] = {}
    for agent_id in scenario.roster:
        command, agent = scenario.command_of(agent_id), agents.get(str(agent_id))
        ran = tuple(command) if command else None, agent.version if agent else None
        alike.setdefault(ran, []).append(agent_id)
    return [AgentProgram(tuple(alike_agents), command, version) for (command, version), alike_agents in alike.items()]


def in_sentence(ran: Iterable[AgentProgram]) -> str:
    return "; ".join(program.in_words for program in ran)
