"""What the right agent makes of the same input in the same state: whoever does anything else takes a wrong step.

The right agent is put into whatever state the wrong one has come to, so each step is judged by itself: also one that is
wrong and of which nothing comes.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from harness.checker.steps.deviation import differences
from harness.proof.model._snapshot import Snapshot, dead, key_of, put_back, take
from ucp.agent import HANDLERS, Agent
from ucp.trace import HandlerRun

Give = Callable[[Agent], None]
"""Gives an input to an agent."""
Make = Callable[[int, bool, Callable[[], None] | None], Agent]
"""A new agent: its ID, whether it is right, and what to call after each handler run, if it is to trace them."""


class _Run(NamedTuple):
    """One handler's, and what it left behind."""

    run: HandlerRun
    left: tuple[Any, ...]


class Reference:
    """Right agents by agent ID."""

    def __init__(self, make: Make) -> None:
        self._make = make
        self._right: dict[int, Agent] = {}

    def deviation(
        self,
        agent_id: int,
        agent: Agent,
        crashed: str | None,
        before: Snapshot | None,
        give: Give,
        name_of: Callable[[str], str],
    ) -> tuple[str, str] | None:
        """Handler and sentence if the right agent does not do what `agent` did; None if it does.

        `before` is the state in which the agent was given the input, None if it had just been switched on. `name_of`
        names a block for people, by its hash.
        """
        if before is None or agent_id not in self._right:
            self._right[agent_id] = self._make(agent_id, True, None)
        right = self._right[agent_id]
        error = _give(right, before, give)
        outcome = _outcome(right)
        right.messages_to_send()
        if error is not None:
            del self._right[agent_id]  # in what state it is nobody knows
        if (error is None) == (crashed is None) and outcome == _outcome(agent):
            return None
        did, should = (self._traced(agent_id, is_right, before, give) for is_right in (False, True))
        return _first_difference(did, should, name_of)

    def _traced(self, agent_id: int, is_right: bool, before: Snapshot | None, give: Give) -> list[_Run]:
        """The handlers that run, and what each leaves behind."""
        left: list[tuple[Any, ...]] = []
        agent = self._make(agent_id, is_right, lambda: left.append(_outcome(agent)))
        _give(agent, before, give)
        runs = [entry for entry in agent.trace() if isinstance(entry, HandlerRun)]
        return [_Run(run, after) for run, after in zip(runs, left, strict=False)]  # a crash leaves nothing behind


def _give(agent: Agent, before: Snapshot | None, give: Give) -> Exception | None:
    if before is not None:
        put_back(agent, before)
    try:
        give(agent)
    except Exception as error:  # a wrong agent's state may be one that no handler was written for
        return error
    return None


def _outcome(agent: Agent) -> tuple[Any, ...]:
    """What the agent is, as far as a right one will ever ask, what it says, and when its timers end."""
    return (
        key_of(take(agent) | dead(agent.state), int.from_bytes),
        [said[1] for said in vars(agent.state)["outbox"]],
        [timer.deadline for timer in agent.state.timers],
    )


def _first_difference(did: Sequence[_Run], should: Sequence[_Run], name_of: Callable[[str], str]) -> tuple[str, str]:
    alike = 0
    for (run, left), (expected, should_leave) in zip(did, should, strict=False):
        if run.handler != expected.handler:
            break
        alike += 1
        words = [f"it {done}; it should have {right}" for done, right in differences(run, expected, name_of)]
        if words:
            return run.handler, f"{_title(run)}: {'; '.join(words)}"
        if left != should_leave and _handler(did, alike) == _handler(should, alike):
            return run.handler, f"{_title(run)}: its state, or a timer, is not what it should be after it"
    whose = (did or should)[max(alike - 1, 0)].run
    follows, should_follow = _handler(did, alike), _handler(should, alike)
    return whose.handler, f"{_title(whose)}: what follows it is {follows}; it should be {should_follow}"


def _handler(runs: Sequence[_Run], number: int) -> str:
    return runs[number].run.handler if number < len(runs) else "nothing"


def _title(run: HandlerRun) -> str:
    return f"Algorithm {HANDLERS[run.handler].algorithm}, {run.handler}"
