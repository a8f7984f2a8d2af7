"""Parse the option `--ucp-agent [ID=]COMMAND`, which selects the programs of the agents of a scenario."""

import re
import shlex
from collections.abc import Iterable, Mapping

from harness.errors import ScenarioError
from harness.scenario.scenario import Scenario

_AGENT_PREFIX = re.compile(r"(?P<agent>[0-9]{1,5})=")

Programs = Mapping[int | None, list[str]]
"""Agent ID -> command. The key None stands for all agents that have no own entry."""


def programs_of(options: Iterable[str]) -> Programs:
    """Return the programs that the options name. Raises ScenarioError for an invalid option."""
    programs: dict[int | None, list[str]] = {}
    for option in options:
        prefix = _AGENT_PREFIX.match(option)
        agent_id = int(prefix["agent"]) if prefix else None
        if agent_id in programs:
            raise ScenarioError(f"--ucp-agent names two programs for {prefix['agent'] if prefix else 'all'}")
        programs[agent_id] = _split_command(option[prefix.end() :] if prefix else option)
    return programs


def command_keys(scenario: Scenario, programs: Programs) -> dict[str, object]:
    """Return the scenario keys that select these programs. The result is empty if there are no programs."""
    if not programs:
        return {}
    others = programs.get(None)
    asked = {agent_id: others or scenario.command_of(agent_id) for agent_id in scenario.roster}
    named = {agent_id: words for agent_id, words in programs.items() if agent_id is not None}
    return {
        "agent_command": {agent_id: words for agent_id, words in (asked | named).items() if words is not None},
    }


def _split_command(command: str) -> list[str]:
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ScenarioError(f"--ucp-agent is {command!r}: {str(error).lower()}") from None
    if not words:
        raise ScenarioError("--ucp-agent is empty: name a program")
    return words
