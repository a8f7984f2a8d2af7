"""What the right agent makes of the same input in the same state: whoever does anything else takes a wrong step.

The right agent is put into whatever state the wrong one has come to, so each step is judged by itself: also one that is
wrong and of which nothing comes.
"""

from collections.abc import Callable
from itertools import zip_longest
from typing import Any

from harness.checker.steps.deviation import differences
from harness.prove.snapshot import Snapshot, dead, key_of, put_back, take
from ucp.agent import HANDLERS, Agent
from ucp.trace import HandlerRun

Give = Callable[[Agent], None]
"""Gives an input to an agent."""
Make = Callable[[int, bool, bool], Agent]
"""A new agent: its ID, whether it is right, whether it traces what it does."""


class Reference:
    """Right agents by agent ID."""

    def __init__(self, make: Make) -> None:
        self._make = make
        self._right: dict[int, Agent] = {}

    def deviation(
        self, agent: Agent, crashed: str | None, before: Snapshot | None, give: Give, name_of: Callable[[str], str]
    ) -> tuple[str, str] | None:
        """Handler and sentence if the right agent does not do what `agent` did; None if it does.

        `before` is the state in which the agent was given the input, None if it had just been switched on. `name_of`
        names a block for people, by its hash.
        """
        agent_id = agent.agent_id
        if before is None or agent_id not in self._right:
            self._right[agent_id] = self._make(agent_id, True, False)
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

    def _traced(self, agent_id: int, is_right: bool, before: Snapshot | None, give: Give) -> list[HandlerRun]:
        agent = self._make(agent_id, is_right, True)
        _give(agent, before, give)
        return [entry for entry in agent.trace() if isinstance(entry, HandlerRun)]


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


def _first_difference(
    did: list[HandlerRun], should: list[HandlerRun], name_of: Callable[[str], str]
) -> tuple[str, str]:
    before = None
    for run, expected in zip_longest(did, should):
        if run is None or expected is None or run.handler != expected.handler:
            break
        words = [f"it {done}; it should have {right}" for done, right in differences(run, expected, name_of)]
        if words:
            return run.handler, f"{_title(run)}: {'; '.join(words)}"
        before = run
    else:
        run = expected = None
    what = f"what follows it is {_names(run)}; it should be {_names(expected)}" if run or expected else "its state"
    whose = before or run or expected
    assert whose is not None, "an input is a handler's"
    return whose.handler, f"{_title(whose)}: {what}"


def _title(run: HandlerRun) -> str:
    return f"Algorithm {HANDLERS[run.handler].algorithm}, {run.handler}"


def _names(run: HandlerRun | None) -> str:
    return "nothing" if run is None else run.handler
