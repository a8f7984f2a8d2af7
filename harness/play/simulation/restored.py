"""A swarm in virtual time that is made of what agents held, instead of beginning with nothing."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from harness.play.simulation._simulated_agent import Stored
from harness.play.simulation.run_files import Recorder
from harness.play.simulation.simulation import Simulation
from harness.scenario import Scenario
from ucp.store import StoredState


class Restored(Simulation):
    """Agents boot with what is `stored` of them, but for their deques, which each is given when it is its turn.

    Agents that all propose at once answer nobody while they reconcile, and may go on so for ever. Who is on the
    scenario's roster and has nothing stored is not there.
    """

    def __init__(
        self, scenario: Scenario, stored: Mapping[int, StoredState], recorder: Recorder, **options: Any
    ) -> None:
        """`options` are the simulation's."""
        super().__init__(scenario, 0, recorder, **options)
        self._stored = stored
        self._generating = False

    async def give_deque(self, agent_id: int) -> None:
        """The agent boots again with what it holds now, and with the deque that it came with."""
        life = self._alive[self._number[agent_id]]
        assert life is not None and life.state is not None, "it booted at the beginning"
        state = life.state
        now = StoredState.of(state)
        deque = [block for block in self._stored[agent_id].deque if not state.holds(block.block_hash)]
        await self.end_incarnation(agent_id)
        self._disks[self._number[agent_id]] = replace(now, deque=[*now.deque, *deque])
        await self.begin_incarnation(agent_id)

    def _start(self, number: int, stored: Stored | None = None) -> None:
        first = self._stored.get(self.roster[number])
        if stored is not None:
            super()._start(number, stored)
        elif first is not None:
            super()._start(number, replace(first, deque=[]))
