"""Call the reference implementation in tests. Each method gives it one input and returns the resulting handler runs."""

from collections.abc import Iterable
from typing import NamedTuple

from harness.checker.reference.algorithms import HANDLERS
from harness.checker.reference.reference_agent import ReferenceAgent
from harness.checker.reference.state import Handler, Settings, Timer
from ucp.block import Block
from ucp.events import LoggableEvent
from ucp.messages import Datagram, Message
from ucp.store import StoredState
from ucp.trace import Tally


class Step(NamedTuple):
    """A run of a handler. `sent` contains each sent message with its sequence number."""

    handler: Handler
    branch: str
    changes: list[tuple[str, str]]
    sent: list[tuple[int, Message]]
    started: dict[str, float]
    tally: Tally | None


class Agent:
    """The reference implementation of one agent of the mission with this `roster`. `now` is the time in mission
    seconds.
    """

    def __init__(
        self, agent_id: int, roster: Iterable[int], initial_data: bytes, settings: Settings | None = None
    ) -> None:
        self._agent = ReferenceAgent(agent_id, roster, initial_data, settings or Settings())
        self.state = self._agent.state

    def receive(self, sender: int, message: Message, now: float) -> list[Step]:
        self._agent.receive_message(sender, 0, message, now)
        return self._steps()

    def log(self, event: LoggableEvent, now: float) -> list[Step]:
        self._agent.add_event(event, now)
        return self._steps()

    def expire(self, timer: Timer | str, now: float) -> list[Step]:
        """Let a timer expire. The timer is given as an object or by its name. A stopped timer does not expire."""
        name = timer if isinstance(timer, str) else timer.name
        expired = next(each for each in self.state.timers if each.name == name)
        if expired.active:
            self._agent.end_timer(expired, now)
        return self._steps()

    def boot(
        self,
        completed: Iterable[bytes],
        chain: Iterable[Block],
        deque: Iterable[Block],
        stack: Iterable[Block],
        now: float,
    ) -> list[Step]:
        self._agent.boot(StoredState(list(completed), list(chain), list(deque), list(stack)), now)
        return self._steps()

    def begin_reconcile(self, now: float) -> list[Step]:
        self._agent.begin_reconcile(now)
        return self._steps()

    def _steps(self) -> list[Step]:
        steps = []
        for run in self._agent.trace():
            sent = []
            for announced in run.sent:
                assert announced.datagram is not None
                datagram = announced.datagram.content
                assert isinstance(datagram, Datagram)
                sent.append((announced.seq, datagram.message))
            handler = HANDLERS[run.handler]
            steps.append(Step(handler, run.branch, run.changes, sent, run.started or {}, run.tally))
        return steps
