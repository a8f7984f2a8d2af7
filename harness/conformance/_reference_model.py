"""Run the reference implementation next to the agent under test, and save and restore its state.

The step judge uses the same reference implementation (`harness.checker.reference`). The reference receives the same
inputs as the agent under test. The inputs are computed from the reference's state, which contains the agent's real
blocks with the timestamps of the agent's clock.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

from harness.checker.reference.reference_agent import ReferenceAgent
from harness.checker.reference.state import ReferenceState
from harness.checker.reference.state import Settings as ReferenceSettings
from ucp.block import Block
from ucp.events import LoggableEvent
from ucp.messages import Message, encode
from ucp.settings import Settings
from ucp.trace import HandlerRun

AGENT = 1
PEERS = (2, 3, 4)
ROSTER = (AGENT, *PEERS)
STRANGER = 9
INITIAL_DATA = b"conformance"
OLD_US, YOUNG_US = 1_000, 2**62
"""Timestamps of the peers' blocks in microseconds. The first one is older, and the second one is newer, than the
timestamps of all blocks of the agent under test.
"""
EVENT_ID = 7


@dataclass(frozen=True)
class PeerDatagram:
    """A datagram from a simulated agent. `message` is None if `data` is not a valid message."""

    sender: int
    message: Message | None
    data: bytes


@dataclass(frozen=True)
class LoggedEvent:
    """An input: the agent logs an event."""

    data: bytes


@dataclass(frozen=True)
class TimerExpiry:
    """An input: the next timer of the agent expires."""


@dataclass(frozen=True)
class ControlCommand:
    """An input: a command on the control socket of the agent."""

    name: str


Action = PeerDatagram | LoggedEvent | TimerExpiry | ControlCommand


@dataclass(frozen=True)
class ExpectedRun:
    """A handler run of the reference implementation."""

    algorithm: int
    handler: str
    branch: str
    sent: tuple[Message, ...]
    """The messages that the handler sends."""
    changes: bool = False
    """True if the handler run changes chain, deque, stack or completed blocks."""


@dataclass(frozen=True)
class ExpectedOutcome:
    """The handler runs of the reference after one input, in order. The list is empty if the agent must drop the
    input.
    """

    runs: tuple[ExpectedRun, ...]

    @property
    def sent(self) -> list[Message]:
        return [message for run in self.runs for message in run.sent]

    @property
    def algorithm(self) -> int:
        """The number of the Algorithm that handles the input."""
        return self.runs[0].algorithm


class ReferenceModel:
    """The reference agent in a test, with all blocks that occurred in the test and the number of handler runs."""

    def __init__(self, settings: Settings) -> None:
        self.agent = ReferenceAgent(AGENT, ROSTER, INITIAL_DATA, ReferenceSettings.of(settings))
        self.blocks: dict[bytes, Block] = {}
        """Block hash -> block, for the blocks of the simulated peers. Some of these blocks are also in the chain, deque
        or stack of the agent.
        """
        self.datagrams: list[bytes] = []
        """Datagrams that the reference sent after the last input."""
        self.handled = self.reconciles = 0
        self.logged = 0
        self._fresh = 0
        self._sequence = 0

    @property
    def state(self) -> ReferenceState:
        return self.agent.state

    def new_block(self, owner: int, *, young: bool) -> Block:
        """Return a new block of a simulated agent, which the agent under test does not know."""
        self._fresh += 1
        timestamp_us = (YOUNG_US if young else OLD_US) + self._fresh
        event = LoggableEvent(timestamp_us, EVENT_ID, b"of a peer, %d" % self._fresh)
        block = Block(owner, timestamp_us, event.encode())
        self.blocks[block.block_hash] = block
        return block

    def datagram(self, sender: int, message: Message) -> PeerDatagram:
        self._sequence += 1
        return PeerDatagram(sender, message, encode(sender, self._sequence, message))

    def event(self) -> LoggedEvent:
        """Return a new event. With the settings of `VARIANTS`, each event completes a block."""
        self.logged += 1
        return LoggedEvent(b"event %d" % self.logged)

    def feed(self, action: Action, now: float, timestamp_us: int = 0) -> ExpectedOutcome:
        """Give the reference an input, and return its handler runs. `timestamp_us` is the agent's timestamp of an
        event.
        """
        match action:
            case PeerDatagram():
                self.agent.receive_datagram(action.data, now)
            case LoggedEvent():
                self.agent.add_event(LoggableEvent(timestamp_us, EVENT_ID, action.data), now)
            case TimerExpiry():
                self.agent.handle_timer(now)
            case ControlCommand("reconcile"):
                self.agent.begin_reconcile(now)
        self.datagrams = self.agent.datagrams_to_send()
        runs = tuple(_run(entry) for entry in self.agent.trace())
        self.handled += len(runs)
        self.reconciles += sum(run.branch == "begun" for run in runs)
        return ExpectedOutcome(runs)

    def status(self) -> dict[str, Any]:
        """Return the answer that a correct agent gives to the command `status`."""
        state = self.state
        return {
            "idle": state.idle,
            "reconcile_in_progress": state.reconcile_in_progress,
            "chain": len(state.chain),
            "deque": len(state.blocks_to_be_committed),
            "stack": len(state.reconcile_stack),
            "completed": len(state.completed),
            "reconciles": self.reconciles,
            "top_chain_hash": state.chain.top_chain_hash.hex(),
            "handled": self.handled,
        }


def _run(entry: HandlerRun) -> ExpectedRun:
    sent = tuple(announced.datagram.content.message for announced in entry.sent)  # type: ignore[union-attr]
    return ExpectedRun(entry.algorithm, entry.handler, entry.branch, sent, bool(entry.changes))


CONTAINERS = frozenset((bytearray, set, list, deque, dict))


class ModelSnapshot:
    """A saved state of the reference agent. `restore` sets the reference agent back to this state.

    Counters for reports are omitted. Paused timers are omitted too, because no timer is paused between inputs.
    """

    def __init__(self, model: ReferenceModel) -> None:
        self._model = model
        self._parts = [(part, *_sorted(part)) for part in (vars(model), vars(model.state), vars(model.state.chain))]
        self._deadlines = [(timer, timer.deadline) for timer in model.state.timers]

    def restore(self) -> ReferenceModel:
        """Set the reference agent back to the saved state, and return this agent."""
        for part, plain, containers in self._parts:
            part.update(plain)
            for name, value in containers:
                part[name] = _copied(value)
        for timer, deadline in self._deadlines:
            timer.deadline = deadline
        return self._model


def _sorted(part: dict[str, Any]) -> tuple[dict[str, Any], list[tuple[str, Any]]]:
    """Divide the attributes of an object into two groups, and return both groups: the immutable attributes, and copies
    of all other attributes, which are containers.
    """
    containers = [(name, _copied(value)) for name, value in part.items() if type(value) in CONTAINERS]
    return {name: value for name, value in part.items() if type(value) not in CONTAINERS}, containers


def _copied(value: Any) -> Any:
    if type(value) is dict and value and type(next(iter(value.values()))) is list:  # the counts of the candidates
        return {key: item.copy() for key, item in value.items()}
    return value.copy()
