"""Represent incarnations of simulated agents, and name the blocks that the agents complete. An incarnation is the time
of an agent between a start and the next end.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from harness.play.simulation._simulated_agent import VirtualAgent
from harness.play.simulation.air import ScheduledInput
from harness.scenario.scenario import AgentClock
from ucp.clock import MICROSECONDS
from ucp.events import RandomEvents
from ucp.state import AgentState
from ucp.store import StoredState

if TYPE_CHECKING:
    from ucp.secure.secured_agent import OutgoingDatagram


class KeyedAgent(Protocol):
    """An agent that signs and encrypts its messages. The agent runs in this process or as a separate program."""

    def sealed_to_send(self) -> "Iterable[OutgoingDatagram]":
        """Return the datagrams that the agent sent since the previous call, in order."""

    def revoke(self, body: bytes, now: float) -> object:
        """Handle a signed list of vehicles whose keys are revoked."""


@dataclass(slots=True)
class SimulatedIncarnation:
    """An agent in virtual time, from one start to the next end."""

    agent: VirtualAgent
    source: RandomEvents
    clock: AgentClock | None
    """The clock of the agent, or None if the agent's clock shows mission time."""
    started_at: float
    state: AgentState | None = None
    """The protocol state of the agent, or None if the agent is a separate program, whose state the harness cannot read.
    """
    secured: KeyedAgent | None = None
    """The object `agent` with the type `KeyedAgent`, or None if the agent has no keys."""
    rebooted: bool = False
    """True if the agent started with the data on its disk, after a power failure."""
    deadline: float | None = None
    """Mission second at which the agent's next timer expires."""
    waiting: list[ScheduledInput] | None = None
    """Inputs that have arrived during a pause, or None if the agent is not paused."""
    resumed_at: float = 0.0
    """Mission second at which the last pause ended. Answers that arrived during the pause are handled at this time."""
    bytes_sent: int = 0
    handler_runs: int = 0
    """Number of handler runs, which are counted only if a trace is written."""
    ended_at: float | None = None
    completed: int = 0
    """Number of blocks that the agent had completed after its last input. Only for an agent that runs in this process.
    """
    disk: StoredState | None = None
    """The content of the agent's disk after its last input. Only for an agent that runs in this process and may reboot
    with its disk.
    """
    logs: bool = True
    """True while the agent still logs events."""

    @property
    def idle(self) -> bool:
        return self.agent.status().idle if self.state is None else self.state.idle

    @property
    def top_chain_hash(self) -> str:
        return self.agent.status().top_chain_hash if self.state is None else self.state.chain.top_chain_hash.hex()

    def drop_unfinished_input(self) -> None:
        """If the handlers of an input did not finish, forget the blocks that the agent completed during this input,
        because no record contains these blocks.
        """
        if self.state is not None:
            del self.state.completed[self.completed :]

    def local_s(self, mission_s: float) -> float:
        """Return the time on the agent's clock at this mission second."""
        return mission_s if self.clock is None else self.clock.shows(mission_s)

    def timestamp_us(self, mission_s: float) -> int:
        """Return the time on the agent's clock in microseconds, at least 0. After the end of the agent, this is the
        time of its end.
        """
        return max(0, round(self._last_local_s(mission_s) * MICROSECONDS))

    def export(self, mission_s: float) -> dict[str, object]:
        """Return the agent's chain export as JSON."""
        return self.agent.export(self._last_local_s(mission_s), self.timestamp_us(mission_s))

    def mission_s(self, local_s: float) -> float:
        """Return the mission second at which the agent's clock shows `local_s`."""
        return local_s if self.clock is None else self.clock.mission_s(local_s)

    @property
    def chain_changed_at(self) -> float | None:
        """The mission second of the last change of the chain. The value is 0 if the chain never changed, and None if
        the time is unknown.
        """
        local_s = self.agent.chain_changed_at
        return self.mission_s(local_s) if local_s else local_s

    def _last_local_s(self, mission_s: float) -> float:
        """Return the time on the agent's clock. If the agent has ended, return the time of its end."""
        return self.local_s(mission_s if self.ended_at is None else self.ended_at)


class BlockNames:
    """The names of blocks, such as 3.2 for the second block that agent 3 completed."""

    def __init__(self, roster: Sequence[int], incarnations: Sequence[Sequence[SimulatedIncarnation]]) -> None:
        self._roster = roster
        self._incarnations = incarnations
        self._names: dict[bytes, str] = {}

    def of(self, block_hash: bytes) -> str | None:
        """Return the name of a block, such as 3.2. Return None if no agent has completed the block."""
        if block_hash not in self._names:
            for agent_id, incarnations in zip(self._roster, self._incarnations, strict=True):
                completed = dict.fromkeys(
                    block for incarnation in incarnations for block in incarnation.agent.completed()
                )
                self._names.update((block, f"{agent_id}.{count}") for count, block in enumerate(completed, 1))
        return self._names.get(block_hash)
