"""Simulate a swarm whose agents start with stored states instead of empty chains."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from harness.play.simulation._simulated_agent import DiskContents
from harness.play.simulation.run_files import Recorder
from harness.play.simulation.simulation import Simulation
from harness.scenario import Scenario
from ucp.store import StoredState


class RestoredSwarm(Simulation):
    """A simulated swarm whose agents start with stored states. An agent without a stored state does not start.

    Agents start without the blocks in their deques. The method `give_deque` adds these blocks for one agent after
    another. If all agents proposed blocks at once, all of them could be in a reconcile and answer no query, possibly
    forever.
    """

    def __init__(
        self, scenario: Scenario, stored: Mapping[int, StoredState], recorder: Recorder, **options: Any
    ) -> None:
        """Create the swarm. `options` are the options of `Simulation`."""
        super().__init__(scenario, 0, recorder, **options)
        self._stored = stored
        self._generating = False

    async def give_deque(self, agent_id: int) -> None:
        """Restart the agent with its current state. Add the blocks of its stored deque that the agent does not hold."""
        incarnation = self._alive[self._number[agent_id]]
        assert incarnation is not None and incarnation.state is not None, "the agent has booted"
        state = incarnation.state
        now = StoredState.of(state)
        deque = [block for block in self._stored[agent_id].deque if not state.holds(block.block_hash)]
        await self.end_incarnation(agent_id)
        self._disks[self._number[agent_id]] = replace(now, deque=[*now.deque, *deque])
        await self.begin_incarnation(agent_id)

    def _start(self, number: int, stored: DiskContents | None = None) -> None:
        first = self._stored.get(self.roster[number])
        if stored is not None:
            super()._start(number, stored)
        elif first is not None:
            super()._start(number, replace(first, deque=[]))
