"""Manage the foreign agents of a swarm, and the programs that run them."""

import errno
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from harness.errors import MachineError, ScenarioError
from harness.play.process._agent_process import agent_command
from harness.play.process.agent_mission import mission_file
from harness.play.simulation._simulated_agent import DiskContents
from harness.play.simulation.foreign._foreign_agent import ForeignAgent, IncarnationRecord
from harness.play.simulation.foreign._program_pool import SHARED, ProgramPool
from harness.play.simulation.foreign.line_program import LineProgram
from harness.scenario import Scenario
from netem import addresses

if TYPE_CHECKING:
    from harness.play.simulation._secured_agents import SimulatedKeys

MAX_RECORD_BYTES = 128 * 1024 * 1024
"""Maximum size in bytes of all inputs and answers that are recorded in a mission."""


def commands_of(scenario: Scenario) -> dict[int, list[str]]:
    """Return the command of each foreign agent. Raises ScenarioError if a program does not exist."""
    return {agent_id: agent_command(scenario, agent_id) for agent_id in scenario.foreign}


class ForeignSwarm:
    """The foreign agents of a scenario (agents that are separate programs). By default, `programs` is the pool of
    programs that all missions in this process share. `keys` are the keys of a secured mission.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        initial_data: bytes,
        programs: ProgramPool | None,
        *,
        tracing: bool,
        keys: "SimulatedKeys | None" = None,
    ) -> None:
        self.records: list[IncarnationRecord] = []
        self._scenario = scenario
        self._seed = seed
        self._initial_data = initial_data
        self._programs = programs or SHARED
        self._tracing = tracing
        self._keys = keys
        self._commands: Mapping[int, list[str]] = commands_of(scenario)
        self._playing: dict[int, LineProgram] = {}

    def __contains__(self, agent_id: int) -> bool:
        return agent_id in self._commands

    def command_of(self, agent_id: int) -> list[str]:
        """Return the command of the agent. The caller appends `--virtual`."""
        return self._commands[agent_id]

    def start(self) -> None:
        """Start the programs of all foreign agents, so that they load at the same time. Raises HarnessError if a
        program cannot be started.
        """
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

    def begin(
        self, agent_id: int, incarnation: int, now: float, stored: DiskContents | None, *, started_at: float
    ) -> ForeignAgent:
        """Start the agent at mission second `started_at`, when its clock shows `now`. `stored` is the content of its
        disk, or None. Raises HarnessError.
        """
        if agent_id not in self._playing:
            self._start(agent_id)
        program = self._playing[agent_id]
        make: Callable[..., ForeignAgent] = ForeignAgent
        key_fields = None
        if self._keys is not None:
            from harness.play.simulation.foreign._foreign_secured import SecuredForeignAgent  # needs the extra `secure`

            make = partial(SecuredForeignAgent, self._keys.mission.bundles[agent_id])
            key_fields = self._keys.key_fields(agent_id, incarnation, started_at)
        agent = make(
            self._mission(agent_id, incarnation),
            self._initial_data,
            self._scenario.settings_of(agent_id),
            program,
            now,
            tracing=self._tracing,
            store=stored,
            key_fields=key_fields,
            clock=self._scenario.clocks.get(agent_id),
            record_bytes=MAX_RECORD_BYTES // len(self._commands),
        )
        self.records.append(agent.record)
        return agent

    def ended(self, agent_id: int) -> None:
        """Return the program of an ended agent to the pool, so that another agent can use this program."""
        if (program := self._playing.pop(agent_id, None)) is not None:
            self._programs.give_back(program)

    def close(self) -> None:
        """Return all programs to the pool."""
        for program in self._playing.values():
            self._programs.give_back(program)
        self._playing.clear()

    def _mission(self, agent_id: int, incarnation: int) -> dict[str, Any]:
        """Return the mission file of an agent. Some values differ from the mission file of a real process, because
        virtual time requires other values.
        """
        mission = mission_file(
            agent_id,
            self._scenario,
            self._seed,
            self._initial_data,
            address=addresses.address(agent_id),
            broadcast=addresses.BROADCAST,
            with_vehicle=False,
            incarnation=incarnation,
            epoch_us=0,
            store="store" if agent_id in self._scenario.with_disk() else None,
            bundle=f"{agent_id}.bundle.json" if self._keys else None,
        )
        mission["events"]["source"] = "none"
        return {**mission, "speedup": 1, "store": None}  # the list `features` still requires stores
