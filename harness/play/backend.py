"""Define the interface of a backend, the part of the harness that runs a scenario.

Code that treats backends differently reads one of the properties defined here, and never compares names of backends. A
new backend needs a folder here, its name in `harness.backend_names`, and an entry in the table `harness.play.backends`.
"""

import asyncio
from abc import ABC, abstractmethod
from contextlib import AbstractAsyncContextManager
from random import Random
from typing import ClassVar

from harness.archive.directory import RunDirectory
from harness.backend_names import BackendName
from harness.play._pace import VirtualTimePace
from harness.play.mission import Swarm
from harness.play.progress import ProgressDisplay
from harness.scenario import Scenario


class Backend(ABC):
    """A backend: a way to run scenarios, for example as processes or in virtual time."""

    name: ClassVar[BackendName]
    virtual_time: ClassVar[bool] = False
    """True if the backend computes mission time in a simulation. Such a run has no speedup, no telemetry, and no delays
    by a slow machine.
    """
    plays_in_memory: ClassVar[bool] = False
    """True if `harness.run.simulate` can carry out the same run in memory, which makes runs of many seeds fast."""

    not_in_uml: ClassVar[str | None] = None
    """The reason why this backend cannot run inside User Mode Linux, with a solution. The value is None if the backend
    can run there.
    """

    @abstractmethod
    def refuse(self, scenario: Scenario) -> None:
        """Raise HarnessError if this backend or this machine cannot run the scenario. The message names a solution."""

    def remark(self, scenario: Scenario) -> str | None:
        """Return a sentence about a part of the scenario that this backend treats differently from other backends.
        Return None if there is no such part.
        """
        return None

    @abstractmethod
    def open(
        self,
        scenario: Scenario,
        seed: int,
        rundir: RunDirectory,
        progress: ProgressDisplay,
        interrupted: asyncio.Event,
        *,
        interactive: bool = False,
        delivers_all: bool = False,
        pace: VirtualTimePace | None = None,
    ) -> AbstractAsyncContextManager[Swarm]:
        """Return a context manager that starts the agents of a scenario. The agents write their files to `rundir`.

        `refuse` must have accepted the scenario. If an error ends the mission early, the context catches it and records
        it in `Swarm.played`. Raises HarnessError if the swarm cannot be opened.

        - `interrupted`: ends the mission early when it is set.
        - `interactive`: a user may cause faults that the scenario does not contain, so each agent has a disk.
        - `delivers_all`: in virtual time, agents also receive messages without effect, as in a real network.
        - `pace`: limits the speed of virtual time. Real time ignores it.
        """


def agent_seed(seed: int, agent_id: int, incarnation: int = 1) -> int:
    """Return the seed for the random events and the deliberate errors of an agent. The seed is different after each
    restart of the agent.
    """
    again = f" life {incarnation}" if incarnation > 1 else ""
    return Random(f"{seed}/agent {agent_id}{again}").getrandbits(63)
