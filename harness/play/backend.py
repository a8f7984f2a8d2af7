"""The interface of a backend, and the seeds that it gives its agents.

Code that treats backends differently asks one of these properties, and never for the name of the backend. A new backend
needs a folder here, its name in `harness.backend_names`, and an entry in the table `harness.play.backends`.
"""

import asyncio
from abc import ABC, abstractmethod
from contextlib import AbstractAsyncContextManager
from random import Random
from typing import ClassVar

from harness.archive.directory import RunDirectory
from harness.backend_names import BackendName
from harness.play._pace import Pace
from harness.play.mission import Swarm
from harness.play.progress import Progress
from harness.scenario import Scenario


class Backend(ABC):
    """A backend, which plays any number of scenarios."""

    name: ClassVar[BackendName]
    virtual_time: ClassVar[bool] = False
    """True if mission time is computed. There is then no lag, no speedup and no telemetry."""
    plays_in_memory: ClassVar[bool] = False
    """True if `harness.run.simulate` can play the same run in memory, for sweeps over thousands of runs."""

    not_in_uml: ClassVar[str | None] = None
    """The reason why it does not run inside User Mode Linux, with a solution. None if it does."""

    @abstractmethod
    def refuse(self, scenario: Scenario) -> None:
        """Raise HarnessError, a sentence with a solution, if this backend or this machine cannot play the scenario."""

    def remark(self, scenario: Scenario) -> str | None:
        """Return a sentence about a difference from the scenario, if there is one."""
        return None

    @abstractmethod
    def open(
        self,
        scenario: Scenario,
        seed: int,
        rundir: RunDirectory,
        progress: Progress,
        interrupted: asyncio.Event,
        *,
        told: bool = False,
        delivers_all: bool = False,
        pace: Pace | None = None,
    ) -> AbstractAsyncContextManager[Swarm]:
        """A swarm, opened, for a scenario that has not been refused; it leaves its files in `rundir`.

        Whatever ends the mission early, `interrupted` too, raises inside the block, leaves it, and is on record in
        `played` then, as is everything else. A mission that is `told` while it is played may yet do what the scenario
        says nothing of: so any agent can be rebooted with its disk. With `delivers_all` agents hear, and traces have,
        also what cannot matter to them, as on any real network. Virtual time goes at the `pace`, if there is one; real
        time heeds none. Raises HarnessError if there is no swarm to be had.
        """


def agent_seed(seed: int, agent_id: int, life: int = 1) -> int:
    """Return the seed of an agent's events and quirks. A restarted agent is in its second `life`."""
    again = f" life {life}" if life > 1 else ""
    return Random(f"{seed}/agent {agent_id}{again}").getrandbits(63)
