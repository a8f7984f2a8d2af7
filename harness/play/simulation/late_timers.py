"""Timers that end late, as a scenario's `lateness` has them."""

from collections.abc import Callable
from typing import NamedTuple

from harness.scenario.numbered import numbered
from ucp.state import AgentState


class Running(NamedTuple):
    """A timer that runs: the `number`th, from 0, that the agent has started, and when it ends by the agent's clock."""

    name: str
    number: int
    deadline: float


class LateTimers:
    """Those of one agent, through all of its lives. `text` is as in a scenario."""

    def __init__(self, text: str = "") -> None:
        self.running: dict[str, Running] = {}
        """By name."""
        self._late_by_s = dict(numbered(text))
        self._started = 0

    def look(self, state: AgentState) -> None:
        """See which timers run after an input; of several that it has started the one that `timers` names first."""
        for timer in state.timers:
            known, deadline = self.running.get(timer.name), timer.deadline
            if deadline is None:
                self.running.pop(timer.name, None)
            elif known is None or known.deadline != deadline:
                self.running[timer.name] = Running(timer.name, self._started, deadline)
                self._started += 1

    @property
    def all_have_ended(self) -> bool:
        """Whether none of those that are told to be late runs or is to come: from now on all end when they should."""
        late = self._late_by_s.keys()
        running = {timer.number for timer in self.running.values()}
        return self._started > max(late, default=-1) and running.isdisjoint(late)

    def next(self, at: Callable[[float], float]) -> tuple[float, Running] | None:
        """When which ends next, in mission seconds; `at` is when the agent's clock shows something."""
        ends = ((at(timer.deadline) + self._late_by_s.get(timer.number, 0.0), timer) for timer in self.running.values())
        return min(ends, default=None, key=lambda end: (end[0], end[1].deadline))
