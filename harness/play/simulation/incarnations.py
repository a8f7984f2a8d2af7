"""The lives of agents in virtual time, and what people call the blocks that they complete."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from harness.play.simulation._simulated_agent import VirtualAgent
from harness.play.simulation.air import Happening
from harness.scenario.scenario import Clock
from ucp.clock import MICROSECONDS
from ucp.events import RandomEvents
from ucp.state import AgentState

if TYPE_CHECKING:
    from ucp.secure.secured_agent import OutgoingDatagram


class Secured(Protocol):
    """An agent with keys, whoever made it."""

    def sealed_to_send(self) -> "Iterable[OutgoingDatagram]":
        """What it broadcasts since it was last asked, in order."""

    def revoke(self, body: bytes, now: float) -> object:
        """The authority says whose keys are revoked."""


@dataclass(slots=True)
class Incarnation:
    """An agent from its start, restart or reboot on."""

    agent: VirtualAgent
    source: RandomEvents
    clock: Clock | None
    """None shows mission time."""
    born_at: float
    state: AgentState | None = None
    """What it holds, asks and counts; None of an agent into which nobody sees."""
    secured: Secured | None = None
    """The agent, if it has keys."""
    rebooted: bool = False
    """It came back from a brown-out with what was on its disk."""
    deadline: float | None = None
    """When its next timer ends, in mission seconds."""
    waiting: list[Happening] | None = None
    """What has reached the agent while it is paused; None if it is not."""
    resumed_at: float = 0.0
    """Whatever came before is handled then."""
    bytes_sent: int = 0
    handler_runs: int = 0
    """Counted while tracing."""
    ended_at: float | None = None
    logs: bool = True
    """Whether it still logs events."""

    @property
    def idle(self) -> bool:
        return self.agent.status().idle if self.state is None else self.state.idle

    @property
    def top_chain_hash(self) -> str:
        return self.agent.status().top_chain_hash if self.state is None else self.state.chain.top_chain_hash.hex()

    def local_s(self, mission_s: float) -> float:
        """What the agent takes for mission time."""
        return mission_s if self.clock is None else self.clock.shows(mission_s)

    def timestamp_us(self, mission_s: float) -> int:
        """What the agent's clock shows, or showed at its end, in microseconds; never less than 0."""
        return max(0, round(self._last_local_s(mission_s) * MICROSECONDS))

    def export(self, mission_s: float) -> dict[str, Any]:
        """The agent's chain export, as a document."""
        return self.agent.export(self._last_local_s(mission_s), self.timestamp_us(mission_s))

    def mission_s(self, local_s: float) -> float:
        """When the agent's clock shows `local_s`."""
        return local_s if self.clock is None else self.clock.mission_s(local_s)

    @property
    def chain_changed_at(self) -> float | None:
        """In mission seconds; 0 if it never did, whatever the agent's clock then showed; None if nobody knows."""
        local_s = self.agent.chain_changed_at
        return self.mission_s(local_s) if local_s else local_s

    def _last_local_s(self, mission_s: float) -> float:
        """What the agent takes for mission time, or did at its end."""
        return self.local_s(mission_s if self.ended_at is None else self.ended_at)


class BlockNames:
    """What people call the blocks of `roster`, whose agents have had these `lives` up to now."""

    def __init__(self, roster: Sequence[int], lives: Sequence[Sequence[Incarnation]]) -> None:
        self._roster = roster
        self._lives = lives
        self._names: dict[bytes, str] = {}

    def of(self, block_hash: bytes) -> str | None:
        """`<agent>.<ordinal>` of a block that an agent has completed."""
        if block_hash not in self._names:
            for agent_id, lives in zip(self._roster, self._lives, strict=True):
                completed = dict.fromkeys(block for life in lives for block in life.agent.completed())
                self._names.update((block, f"{agent_id}.{count}") for count, block in enumerate(completed, 1))
        return self._names.get(block_hash)
