"""A driver of the reference: each method takes one input and returns the handler runs that it causes."""

from collections.abc import Collection, Iterable
from typing import NamedTuple

from harness.checker.reference.algorithms import ON_LOCAL_EVENT, ON_MESSAGE, ON_TIMER, Tally, tally_of
from harness.checker.reference.state import Handler, Settings, State, Timer
from ucp.block import Block
from ucp.events import LoggableEvent
from ucp.messages import BlockResponse, CommitBlock, Message


class Step(NamedTuple):
    """A record of one run of a handler. `sent` pairs each message with its sequence number."""

    handler: Handler
    branch: str
    changes: list[tuple[str, str]]
    sent: list[tuple[int, Message]]
    started: dict[str, float]
    tally: Tally | None


class Agent:
    """A driver without I/O. Each method takes one input and returns the steps that it causes.

    `roster` holds the IDs of the mission's agents. `now` is in mission seconds.
    """

    def __init__(
        self, agent_id: int, roster: Collection[int], initial_data: bytes, settings: Settings | None = None
    ) -> None:
        self.state = State(agent_id, initial_data, settings or Settings())
        self.roster = frozenset(roster)

    def receive(self, sender: int, message: Message, now: float) -> list[Step]:
        """Handle a message. Messages from the agent itself or from outside the roster are ignored."""
        if sender == self.state.agent_id or sender not in self.roster:
            return []
        if isinstance(message, CommitBlock | BlockResponse) and message.block.agent_id not in self.roster:
            return []
        return self._input(now, ON_MESSAGE[type(message)], sender, message)

    def log(self, event: LoggableEvent, now: float) -> list[Step]:
        """Handle an event that the vehicle logs."""
        return self._input(now, ON_LOCAL_EVENT["Build Data Block"], event)

    def expire(self, timer: Timer | str, now: float) -> list[Step]:
        """Handle the expiration of a timer, given itself or by its name. A stopped timer does not expire."""
        name = timer if isinstance(timer, str) else timer.name
        expired = next(each for each in self.state.timers if each.name == name)
        if not expired.active:
            return []
        expired.stop()
        return self._input(now, ON_TIMER[name])

    def boot(
        self,
        completed: Iterable[bytes],
        chain: Iterable[Block],
        deque: Iterable[Block],
        stack: Iterable[Block],
        now: float,
    ) -> list[Step]:
        """Start with the agent's stored state. The first step's changes begin with those of `State.restore`."""
        self.state.changes = []
        self.state.restore(completed, chain, deque, stack)
        restored = self.state.changes
        first, *others = self._input(now, ON_LOCAL_EVENT["Reconcile Finalize"])
        return [first._replace(changes=restored + first.changes), *others]

    def begin_reconcile(self, now: float) -> list[Step]:
        """Begin a reconcile on the operator's command."""
        return self._input(now, ON_LOCAL_EVENT["Reconcile Begin"])

    def _input(self, now: float, handler: Handler, *arguments: object) -> list[Step]:
        self.state.now = now
        steps = [self._run(handler, *arguments)]
        while self.state.triggered:
            local_event, _ = self.state.triggered.popleft()
            steps.append(self._run(ON_LOCAL_EVENT[local_event]))
        return steps

    def _run(self, handler: Handler, *arguments: object) -> Step:
        state = self.state
        state.running, state.changes, state.outbox, state.started = handler, [], [], {}
        branch = handler.run(state, *arguments)
        return Step(handler, branch, state.changes, state.outbox, state.started, tally_of(state, handler))
