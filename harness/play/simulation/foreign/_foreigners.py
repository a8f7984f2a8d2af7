"""The agents of a swarm that are not ours: whose program plays whom, in which life."""

import errno
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from harness.errors import MachineError, ScenarioError
from harness.play.process._agent_process import agent_command, reboots_with_disk
from harness.play.process.agent_mission import mission_file
from harness.play.simulation._simulated_agent import Stored, VirtualAgent
from harness.play.simulation.foreign._foreign_agent import ForeignAgent, LifeRecord
from harness.play.simulation.foreign._virtual_program import SHARED, Program, Programs
from harness.scenario import Scenario
from netem import addresses

if TYPE_CHECKING:
    from harness.play.simulation._secured_agents import Keys

MAX_RECORD_BYTES = 128 * 1024 * 1024
"""Of all that agents are given and answer in a mission, so much is kept, to be given to them again."""


def commands_of(scenario: Scenario) -> dict[int, list[str]]:
    """What starts which foreign agent. Raises ScenarioError if there is no such program."""
    return {agent_id: agent_command(scenario, agent_id) for agent_id in scenario.foreign}


class Foreigners:
    """Those of `scenario`. `programs` play them, by default those that all missions in this process share.

    `keys` are the mission's, if it is secured.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        initial_data: bytes,
        programs: Programs | None,
        *,
        tracing: bool,
        keys: "Keys | None" = None,
    ) -> None:
        self.records: list[LifeRecord] = []
        self._scenario = scenario
        self._seed = seed
        self._initial_data = initial_data
        self._programs = programs or SHARED
        self._tracing = tracing
        self._keys = keys
        self._commands: Mapping[int, list[str]] = commands_of(scenario)
        self._playing: dict[int, Program] = {}

    def __contains__(self, agent_id: int) -> bool:
        return agent_id in self._commands

    def command_of(self, agent_id: int) -> list[str]:
        """What starts the agent, but for --virtual."""
        return self._commands[agent_id]

    def start(self) -> None:
        """Start whoever will play, all at the same time. Raises HarnessError if a program cannot be started."""
        for agent_id in self._commands:
            self._start(agent_id)

    def _start(self, agent_id: int) -> None:
        command = self._commands[agent_id]
        try:
            self._playing[agent_id] = self._programs.take(command, agent_id)
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                raise MachineError(
                    f"agent {agent_id} cannot be started: {error.strerror}; allow more with `ulimit -n`"
                ) from None
            raise ScenarioError(f"`agent_command`: {command[0]} cannot be started: {error.strerror}") from None

    def begin(self, agent_id: int, life: int, now: float, stored: Stored | None, *, born_at: float) -> ForeignAgent:
        """A life of the agent, which goes on from what is `stored` of an earlier one. Raises HarnessError.

        It is `now` by the agent's clock, and in mission seconds it is `born_at`.
        """
        if agent_id not in self._playing:
            self._start(agent_id)
        program = self._playing[agent_id]
        make: Callable[..., ForeignAgent] = ForeignAgent
        handed = None
        if self._keys is not None:
            from harness.play.simulation.foreign._foreign_secured import SecuredForeignAgent  # needs the extra `secure`

            make = partial(SecuredForeignAgent, self._keys.mission.bundles[agent_id])
            handed = self._keys.handed(agent_id, life, born_at)
        agent = make(
            self._mission(agent_id, life),
            self._initial_data,
            self._scenario.settings_of(agent_id),
            program,
            now,
            tracing=self._tracing,
            store=stored,
            handed=handed,
            record_bytes=MAX_RECORD_BYTES // len(self._commands),
        )
        self.records.append(agent.record)
        return agent

    def ended(self, agent: VirtualAgent) -> None:
        """The agent's life is over: its program may play another."""
        if (program := self._playing.pop(agent.agent_id, None)) is not None:
            self._programs.give_back(program)

    def close(self) -> None:
        """All lives are over."""
        for program in self._playing.values():
            self._programs.give_back(program)
        self._playing.clear()

    def _mission(self, agent_id: int, life: int) -> dict[str, Any]:
        """What it would be told as a process, but for what virtual time has otherwise."""
        mission = mission_file(
            agent_id,
            self._scenario,
            self._seed,
            self._initial_data,
            address=addresses.address(agent_id),
            broadcast=addresses.BROADCAST,
            with_vehicle=False,
            incarnation=life,
            epoch_us=0,
            store="store" if reboots_with_disk(agent_id, self._scenario) else None,
            bundle=f"{agent_id}.bundle.json" if self._keys else None,
        )
        mission["events"]["source"] = "none"
        return {**mission, "speedup": 1, "store": None}  # that it may be asked for one `features` says
