"""What the command line of pytest says about runs; it has the last word over tests and scenarios."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import pytest

from harness.backend_names import BackendName
from harness.errors import ScenarioError
from harness.scenario import Scenario
from harness.scenario.load import parse

OF_ONE = re.compile(r"(?P<agent>[0-9]{1,5})=")


@dataclass(frozen=True)
class Options:
    """None where the command line says nothing."""

    backend: BackendName | None
    seed: int | None
    speedup: float | None
    keep: Path | None
    """Where all run directories are kept, absolute."""
    in_uml: bool
    """Whether processes are to be played in User Mode Linux."""
    image_from_host: bool
    """Whether containers are made of this machine's own files."""
    agent_commands: dict[int | None, list[str]]
    """By agent; under None, of all that are not named. Whoever is not here is as scenarios say."""
    rewrite: bool
    """Whether stories are written anew, not compared."""

    @classmethod
    def of(cls, config: pytest.Config) -> "Options":
        """Raises ScenarioError."""
        backend, seed, speedup, keep = (
            config.getoption(f"--ucp-{name}") for name in ("backend", "seed", "speedup", "keep")
        )
        if seed is not None and seed < 0:
            raise ScenarioError(f"--ucp-seed is {seed}: use a number from 0 on")
        return cls(
            backend,
            seed,
            speedup,
            keep and config.invocation_params.dir / keep,
            config.getoption("--ucp-kernel") == "uml",
            config.getoption("--ucp-image-from-host"),
            _by_agent(config.getoption("--ucp-agent") or []),
            config.getoption("--ucp-rewrite"),
        )

    def laid_over(self, scenario: Scenario) -> Scenario:
        """The scenario as it is to be played. Raises ScenarioError."""
        document = scenario.model_dump()
        if self.speedup is not None:
            document["speedup"] = self.speedup
        if self.agent_commands:
            document["agent_command"] = self._laid_over_commands(scenario)
        if self.image_from_host:
            document["docker"]["image_from_host"] = True
        return parse(document) if document != scenario.model_dump() else scenario

    def _laid_over_commands(self, scenario: Scenario) -> dict[int, list[str]]:
        others = self.agent_commands.get(None)
        asked = {agent_id: others or scenario.command_of(agent_id) for agent_id in scenario.roster}
        named = {agent_id: words for agent_id, words in self.agent_commands.items() if agent_id is not None}
        return {agent_id: words for agent_id, words in (asked | named).items() if words is not None}

    def refuse(self, backend: BackendName) -> None:
        """Raises MachineError, with the reason, for a backend that cannot play where the command line wants it to."""
        if self.in_uml:
            from harness.pytest_plugin._kernel_option import refuse_outside

            refuse_outside(backend)


def _by_agent(commands: list[str]) -> dict[int | None, list[str]]:
    """Raises ScenarioError."""
    by_agent: dict[int | None, list[str]] = {}
    for command in commands:
        of_one = OF_ONE.match(command)
        agent_id = int(of_one["agent"]) if of_one else None
        if agent_id in by_agent:
            raise ScenarioError(f"--ucp-agent names two programs for {of_one['agent'] if of_one else 'all'}")
        by_agent[agent_id] = _words(command[of_one.end() :] if of_one else command)
    return by_agent


def _words(command: str) -> list[str]:
    """Raises ScenarioError."""
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ScenarioError(f"--ucp-agent is {command!r}: {str(error).lower()}") from None
    if not words:
        raise ScenarioError("--ucp-agent is empty: name a program")
    return words
