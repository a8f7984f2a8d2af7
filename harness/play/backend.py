"""The interface of a backend, and the seeds that it gives its agents.

Whoever treats backends differently asks one of these properties, and never which backend it is. A new one is a room of
its own here, its name in `harness.backend_names`, and its place in the table `harness.play.backends`.
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
    """Plays scenarios, any number of them."""

    name: ClassVar[BackendName]
    virtual_time: ClassVar[bool] = False
    """Whether mission time is computed: no machine is late for it, a speedup means nothing, there is no telemetry."""
    plays_in_memory: ClassVar[bool] = False
    """Whether `harness.run.simulate` plays the same without a run directory, for sweeps over thousands of runs."""

    not_in_uml: ClassVar[str | None] = None
    """Why it does not play inside User Mode Linux, and the way out; None if it does."""

    @abstractmethod
    def refuse(self, scenario: Scenario) -> None:
        """Raises HarnessError, a sentence with the way out, if the scenario cannot be played so, or not here."""

    def remark(self, scenario: Scenario) -> str | None:
        """What it plays otherwise than the scenario says, in a sentence, if anything."""
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
    """What an agent's events and quirks are drawn from; an agent that was restarted is in its second `life`."""
    again = f" life {life}" if life > 1 else ""
    return Random(f"{seed}/agent {agent_id}{again}").getrandbits(63)
