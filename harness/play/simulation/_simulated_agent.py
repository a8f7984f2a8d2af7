"""An agent as the simulation drives it: the harness's own, in this process, or one behind standard input and output."""

from collections.abc import Sequence
from typing import Any, Protocol

from harness.play.agent_control import Status
from ucp.agent import Agent
from ucp.events import LoggableEvent
from ucp.export import export_chain
from ucp.messages import Message
from ucp.settings import Settings
from ucp.store import StoredState
from ucp.trace import Entry, Recorded

Outgoing = tuple[int, Message | None, Recorded | None]
"""What an agent broadcasts: sequence, message, and the datagram as it is on record, None if nobody has that.

Of a datagram that is no message of the agent's own there is only the last."""

Stored = StoredState | tuple[Any]
"""What a brown-out leaves on an agent's disk; of an agent of another make (whatever it calls so,)."""


class VirtualAgent(Protocol):
    """`now` is what the agent's clock shows, in mission seconds; it never goes back. Everything raises HarnessError."""

    agent_id: int
    roster: frozenset[int]

    @property
    def messages_sent(self) -> int: ...

    @property
    def chain_changed_at(self) -> float | None:
        """By its clock; 0 if it never did, None if nobody knows."""

    @property
    def initial_data(self) -> bytes: ...

    @property
    def settings(self) -> Settings: ...

    def receive_message(
        self, sender: int, sequence: int, message: Message, now: float, datagram: Recorded | None = None
    ) -> None: ...

    def receive_datagram(self, data: bytes, now: float) -> None: ...

    def add_event(self, event: LoggableEvent, now: float) -> None: ...

    def handle_timer(self, now: float) -> None: ...

    def begin_reconcile(self, now: float) -> None: ...

    def next_timer(self) -> float | None: ...

    def answers_nobody_until(self) -> float | None: ...

    def outgoing(self) -> Sequence[Outgoing]:
        """What it broadcasts since it was last asked, in order."""

    def trace(self) -> list[Entry]: ...

    # What it says of itself

    def status(self) -> Status: ...

    def known_status(self) -> Status | None:
        """None of an agent that failed: what it said before is no longer so."""

    def completed(self) -> list[bytes]:
        """Hashes of the blocks that it completed, in order."""

    def export(self, now: float, exported_at_us: int) -> dict[str, Any]:
        """Its chain export, as a document."""

    def stored(self, now: float) -> Stored: ...

    def leave(self, now: float) -> None:
        """Its life ends; what it said of itself by then it says for ever."""


class OwnAgent(Agent):
    """The harness's own."""

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

    def outgoing(self) -> Sequence[Outgoing]:
        return self._due_to_send()

    def status(self) -> Status:
        state = self.state
        return Status.model_construct(
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

    def known_status(self) -> Status:
        return self.status()

    def completed(self) -> list[bytes]:
        return self.state.completed

    def export(self, now: float, exported_at_us: int) -> dict[str, Any]:
        return export_chain(self.state, exported_at_us)

    def stored(self, now: float) -> StoredState:
        return StoredState.of(self.state)

    def leave(self, now: float) -> None:
        """It keeps its state."""
