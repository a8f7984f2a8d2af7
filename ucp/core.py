"""The operations with which event handlers change the state of their agent. Event handlers use this interface, and
callers of an agent use `ucp.agent`. A handler may use only the messages, timers and local events that it declares. An
operation with any other message, timer or local event raises an error.
"""

from collections.abc import Callable, Iterable
from typing import Any

from ucp.block import MAX_EVENT_DATA_BYTES, Block
from ucp.handler import EventHandler, LocalEvent
from ucp.messages import Message
from ucp.sealed import SEAL_BYTES
from ucp.settings import Settings
from ucp.state import AgentState
from ucp.timers import Timer
from ucp.trace import RecordedBytes, SentMessage

Seal = Callable[[bytes, int], bytes]
"""The type of a function that encrypts event data. Its arguments are the event data and the timestamp of the block."""


class Core(AgentState):
    """The state of an agent, and the operations of its handlers.

    The object stores the results of a handler until the agent collects them. If `tracing` is false, it records no
    `changes`, `announced` and `started`, and no datagrams in `outbox`.
    """

    running: EventHandler[Any]
    """The event handler that is running."""

    def __init__(
        self,
        agent_id: int,
        initial_data: bytes,
        settings: Settings,
        *,
        tracing: bool = True,
        seal: Seal | None = None,
    ) -> None:
        super().__init__(agent_id, initial_data, settings)
        self.outbox: list[tuple[int, Message, RecordedBytes | None]] = []
        """The messages to broadcast, as (sequence number, message, recorded datagram)."""
        self.changes: list[tuple[str, str]] = []
        """The changes of chain, deque and stack by the running handler, in the form of a trace line."""
        self.announced: list[SentMessage] = []
        """The messages that the running handler has sent, in the form of a trace line."""
        self.started: dict[str, float] = {}
        """Timer that the running handler has started -> its duration in mission seconds."""
        if seal is not None and settings.max_block_bytes + SEAL_BYTES > MAX_EVENT_DATA_BYTES:
            raise ValueError(f"with sealed event data, max_block_bytes is at most {MAX_EVENT_DATA_BYTES - SEAL_BYTES}")
        self.sealed: bytes | None = None
        """The event data that the running handler encrypted, or None. The trace contains it, because a replay cannot
        encrypt the event data again.
        """
        self._seal = seal
        self._tracing = tracing
        self._sequence = 0

    def trigger(self, event: LocalEvent) -> None:
        """Trigger a local event. Its handler runs after the running handler has ended."""
        assert event in self.running.triggers, f"{self.running.name} does not declare that it triggers {event}"
        self.triggered.append((event, self.running.name))

    def send(self, message: Message) -> None:
        """Broadcast `message` to all vehicles in range (the local UVS of the thesis)."""
        assert type(message) in self.running.sends, f"{self.running.name} does not declare that it sends {message.NAME}"
        self.sent[message.NAME] += 1
        datagram = None
        if self._tracing:
            announced = SentMessage.of(self.agent_id, self._sequence, message)
            self.announced.append(announced)
            datagram = announced.datagram
        self.outbox.append((self._sequence, message, datagram))
        self._sequence += 1

    def start(self, timer: Timer, duration_s: float) -> None:
        """Start `timer`, so that it expires after `duration_s` mission seconds."""
        assert timer.name in self.running.starts, f"{self.running.name} does not declare that it starts {timer.name}"
        timer.start(self.now, duration_s)
        if self._tracing:
            self.started[timer.name] = duration_s

    def restore(
        self, completed: Iterable[bytes], chain: Iterable[Block], deque: Iterable[Block], stack: Iterable[Block]
    ) -> None:
        """Restore the blocks that the agent held before it ended. A reconcile that was in progress is ended."""
        self.reconcile_in_progress = True
        for block_hash in completed:
            self.completed.append(block_hash)
            if self._tracing:
                self.changes.append(("complete", block_hash.hex()))
        for block in chain:
            self.commit(block)
        for block in deque:
            self.push_onto_deque(block)
        for block in stack:
            self.push_onto_stack(block)
        own = set(self.completed)  # other agents may have sent blocks in its name
        for block in (*self.chain, *self.blocks_to_be_committed, *self.reconcile_stack):
            if block.block_hash in own:
                self.newest_block_timestamp_us = max(self.newest_block_timestamp_us, block.timestamp_us)

    def event_data(self, timestamp_us: int) -> bytes:
        """Return the event data of the block under construction. The data is encrypted if the mission requires this
        (`ucp.secure`).
        """
        events = bytes(self.current_block)
        if self._seal is None:
            return events
        self.sealed = self._seal(events, timestamp_us)
        return self.sealed

    def complete(self, block: Block) -> None:
        """Push a newly completed block of this agent onto the back of the deque."""
        self.completed.append(block.block_hash)
        self.newest_block_timestamp_us = block.timestamp_us
        self._changed("complete", block)
        self.push_onto_deque(block)

    def push_onto_deque(self, block: Block) -> None:
        self.blocks_to_be_committed.append(block)
        self._held_aside.add(block.block_hash)
        self._changed("deque+", block)

    def take_from_deque(self) -> Block:
        block = self.blocks_to_be_committed.popleft()
        self._held_aside.remove(block.block_hash)
        self._changed("deque-", block)
        return block

    def commit(self, block: Block) -> None:
        """Append `block` to the chain, and compute its chain hash (eq. 3.2)."""
        self.chain.append(block)
        self.chain_changed_at = self.now
        self._changed("chain+", block)

    def pop_to_stack(self) -> None:
        """Move the newest block of the chain to the top of the reconcile stack."""
        block = self.chain.pop()
        self.chain_changed_at = self.now
        self._changed("chain-", block)
        self.push_onto_stack(block)

    def push_onto_stack(self, block: Block) -> None:
        self.reconcile_stack.append(block)
        self._held_aside.add(block.block_hash)
        self._changed("stack+", block)

    def pop_from_stack(self) -> Block:
        block = self.reconcile_stack.pop()
        self._held_aside.remove(block.block_hash)
        self._changed("stack-", block)
        return block

    def remove_from_stack(self, block_hash: bytes) -> Block | None:
        """Remove this block from the reconcile stack, and return it. Return None if the stack does not contain it."""
        for position in range(len(self.reconcile_stack) - 1, -1, -1):  # the mutual successor is mostly on top
            if self.reconcile_stack[position].block_hash == block_hash:
                block = self.reconcile_stack.pop(position)
                self._held_aside.remove(block_hash)
                self._changed("stack-", block)
                return block
        return None

    def _changed(self, operation: str, block: Block) -> None:
        if self._tracing:
            self.changes.append((operation, block.block_hash.hex()))
