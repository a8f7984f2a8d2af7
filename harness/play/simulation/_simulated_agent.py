"""Define the interface between the simulation and an agent, and implement it for the agents of the harness.

`foreign` implements it with a separate program.
"""

from collections.abc import Sequence
from typing import Any, Protocol

from harness.play.agent_control import AgentStatus
from ucp.agent import Agent
from ucp.events import LoggableEvent
from ucp.export import export_chain
from ucp.messages import Message
from ucp.settings import Settings
from ucp.store import StoredState
from ucp.trace import Entry, RecordedBytes

AgentOutput = tuple[int, Message | None, RecordedBytes | None]
"""A datagram that an agent sent: sequence number, message, and encoded datagram. The encoded datagram is None if the
message is not encoded yet. For data that are no valid message, the sequence number is 0 and the message is None.
"""

DiskContents = StoredState | tuple[Any]
"""The content of an agent's disk after a power failure. A foreign agent (a separate program) has its own format, so its
content is a tuple with one opaque value.
"""


class VirtualAgent(Protocol):
    """An agent in virtual time. `now` is the time on the agent's clock in mission seconds, and never decreases.

    All methods and properties raise HarnessError if the agent fails.
    """

    agent_id: int
    roster: frozenset[int]

    @property
    def messages_sent(self) -> int: ...

    @property
    def chain_changed_at(self) -> float | None:
        """The time at which the chain changed last, on the agent's clock. The time is 0 if the chain never changed, and
        None if it is unknown.
        """

    @property
    def initial_data(self) -> bytes: ...

    @property
    def settings(self) -> Settings: ...

    def receive_message(
        self, sender: int, sequence: int, message: Message, now: float, datagram: RecordedBytes | None = None
    ) -> None: ...

    def receive_datagram(self, data: bytes, now: float) -> None: ...

    def add_event(self, event: LoggableEvent, now: float) -> None: ...

    def handle_timer(self, now: float) -> None: ...

    def begin_reconcile(self, now: float) -> None: ...

    def next_timer(self) -> float | None: ...

    def silent_until(self) -> float | None: ...

    def outgoing(self) -> Sequence[AgentOutput]:
        """Return the outputs that the agent created since the previous call, in order."""

    def trace(self) -> list[Entry]: ...

    # Queries about the agent, which are not part of the mission

    def status(self) -> AgentStatus: ...

    def known_status(self) -> AgentStatus | None:
        """Return the status of the agent. Return None if the agent has failed."""

    def completed(self) -> list[bytes]:
        """Return the hashes of the blocks that the agent has completed, in order."""

    def export(self, now: float, exported_at_us: int) -> dict[str, Any]:
        """Return the chain export of the agent as JSON."""

    def stored(self, now: float) -> DiskContents: ...

    def end(self, now: float) -> None:
        """End the agent. After this call, the methods return the state at the time `now`."""


class OwnAgent(Agent):
    """An agent of the harness that runs in this process."""

    @property
    def initial_data(self) -> bytes:
        return self.state.chain.inception.block_data

    @property
    def settings(self) -> Settings:
        return self.state.settings

    @property
    def messages_sent(self) -> int:
        return self.state.sent.total()

    @property
    def chain_changed_at(self) -> float:
        return self.state.chain_changed_at

    def outgoing(self) -> Sequence[AgentOutput]:
        return self._due_to_send()

    def status(self) -> AgentStatus:
        state = self.state
        return AgentStatus.model_construct(
            started=True,
            idle=state.idle,
            reconcile_in_progress=state.reconcile_in_progress,
            chain=len(state.chain),
            deque=len(state.blocks_to_be_committed),
            stack=len(state.reconcile_stack),
            completed=len(state.completed),
            reconciles=state.reconciles,
            top_chain_hash=state.chain.top_chain_hash.hex(),
            dropped=dict(self.dropped),
        )

    def known_status(self) -> AgentStatus:
        return self.status()

    def completed(self) -> list[bytes]:
        return self.state.completed

    def export(self, now: float, exported_at_us: int) -> dict[str, Any]:
        return export_chain(self.state, exported_at_us)

    def stored(self, now: float) -> StoredState:
        return StoredState.of(self.state)

    def end(self, now: float) -> None:
        """Do nothing, because this object keeps the last state of the agent."""
