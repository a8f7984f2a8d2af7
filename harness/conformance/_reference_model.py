"""The reference beside the agent under test, and saved moments of it.

It is the independent reference (`harness.checker.reference`), and gets the inputs of the agent under test at the same
time. Inputs are chosen by its state, so that they fit the blocks that the agent really made, whatever its clock shows.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

from harness.checker.reference.reference_agent import ReferenceAgent
from harness.checker.reference.state import Settings as ReferenceSettings
from harness.checker.reference.state import State
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
"""Timestamps of peers' blocks: before, and after, any that the agent under test can make."""
EVENT_ID = 7


@dataclass(frozen=True)
class Datagram:
    """A peer's message; or bytes that are none."""

    sender: int
    message: Message | None
    data: bytes


@dataclass(frozen=True)
class Log:
    """The agent logs an event."""

    data: bytes


@dataclass(frozen=True)
class Expire:
    """The next timer ends."""


@dataclass(frozen=True)
class Command:
    """The control socket's command."""

    name: str


Action = Datagram | Log | Expire | Command


@dataclass(frozen=True)
class Run:
    """A run of a handler: which branch it must take, and what it must send."""

    algorithm: int
    handler: str
    branch: str
    sent: tuple[Message, ...]
    changes: bool = False
    """Whether it changes what the agent holds."""


@dataclass(frozen=True)
class Outcome:
    """What must come of an input: handler runs in order, none if it is dropped."""

    runs: tuple[Run, ...]

    @property
    def sent(self) -> list[Message]:
        return [message for run in self.runs for message in run.sent]

    @property
    def algorithm(self) -> int:
        """To which the input is given."""
        return self.runs[0].algorithm


class Model:
    """The reference agent, the blocks that there are by now, and how many handlers have run."""

    def __init__(self, settings: Settings) -> None:
        self.agent = ReferenceAgent(AGENT, ROSTER, INITIAL_DATA, ReferenceSettings.of(settings))
        self.blocks: dict[bytes, Block] = {}
        """Of peers, by hash; what is in the chain, the deque or the stack is there, too."""
        self.datagrams: list[bytes] = []
        """What it sent last."""
        self.handled = self.reconciles = 0
        self.logged = 0
        self._fresh = 0
        self._sequence = 0

    @property
    def state(self) -> State:
        return self.agent.state

    def new_block(self, owner: int, *, young: bool) -> Block:
        """A block that nobody has seen."""
        self._fresh += 1
        timestamp_us = (YOUNG_US if young else OLD_US) + self._fresh
        event = LoggableEvent(timestamp_us, EVENT_ID, b"of a peer, %d" % self._fresh)
        block = Block(owner, timestamp_us, event.encode())
        self.blocks[block.block_hash] = block
        return block

    def datagram(self, sender: int, message: Message) -> Datagram:
        self._sequence += 1
        return Datagram(sender, message, encode(sender, self._sequence, message))

    def event(self) -> Log:
        """An event; with the settings of all missions here each fills a block."""
        self.logged += 1
        return Log(b"event %d" % self.logged)

    def feed(self, action: Action, now: float, timestamp_us: int = 0) -> Outcome:
        """`timestamp_us` is an event's, as the agent under test has it."""
        match action:
            case Datagram():
                self.agent.receive_datagram(action.data, now)
            case Log():
                self.agent.add_event(LoggableEvent(timestamp_us, EVENT_ID, action.data), now)
            case Expire():
                self.agent.handle_timer(now)
            case Command("reconcile"):
                self.agent.begin_reconcile(now)
        self.datagrams = self.agent.datagrams_to_send()
        runs = tuple(_run(entry) for entry in self.agent.trace())
        self.handled += len(runs)
        self.reconciles += sum(run.branch == "begun" for run in runs)
        return Outcome(runs)

    def status(self) -> dict[str, Any]:
        """What the agent must say of itself now."""
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


def _run(entry: HandlerRun) -> Run:
    sent = tuple(announced.datagram.content.message for announced in entry.sent)  # type: ignore[union-attr]
    return Run(entry.algorithm, entry.handler, entry.branch, sent, bool(entry.changes))


CONTAINERS = frozenset((bytearray, set, list, deque, dict))


class Moment:
    """All that matters of a model now, to the last bit.

    What is only counted for a report is not; nor is a timer that is paused: between inputs none is.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self._parts = [(part, *_sorted(part)) for part in (vars(model), vars(model.state), vars(model.state.chain))]
        self._deadlines = [(timer, timer.deadline) for timer in model.state.timers]

    def put_back(self) -> Model:
        """The model, as it was."""
        for part, plain, containers in self._parts:
            part.update(plain)
            for name, value in containers:
                part[name] = _copied(value)
        for timer, deadline in self._deadlines:
            timer.deadline = deadline
        return self._model


def _sorted(part: dict[str, Any]) -> tuple[dict[str, Any], list[tuple[str, Any]]]:
    """What stays as it is, and copies of what changes."""
    containers = [(name, _copied(value)) for name, value in part.items() if type(value) in CONTAINERS]
    return {name: value for name, value in part.items() if type(value) not in CONTAINERS}, containers


def _copied(value: Any) -> Any:
    if type(value) is dict and value and type(next(iter(value.values()))) is list:  # counted, by candidate
        return {key: item.copy() for key, item in value.items()}
    return value.copy()
