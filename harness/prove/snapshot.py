"""The whole state of an agent: copied, put back, and as a key that is equal for equal states.

What is left out of the key changes nothing that the agent will ever do: the moment of its last input, counters that
are only reported, and what it has yet to hand over. Everything else that `ucp.state.AgentState` has is in it, also
what it will have one day; a value of a kind that is not known here is an error, and never left out.
"""

from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from ucp.agent import Agent
from ucp.block import Block
from ucp.chain import Chain
from ucp.timers import Timer

REPORTED = frozenset(("now", "sent", "reconciles", "chain_changed_at", "_sequence"))
"""What an agent only counts or notes; no handler reads it but to make a trace or a datagram's number."""
FIXED = frozenset(("agent_id", "settings", "timers", "reconcile_timers", "running", "_tracing"))
"""What never changes, or is another name of what is there."""
HANDED_OVER = frozenset(("outbox", "changes", "announced", "started"))
LEFT_OUT = REPORTED | FIXED | HANDED_OVER

NOW_S = 1000.0
"""The mission second of every input: what matters of time is in the zones."""
RUNNING_S = 1e15
"""The deadline of a timer that was running before the input."""

Snapshot = dict[str, Any]
NameOf = Callable[[bytes], int]
"""A small number for a hash, always the same."""


def take(agent: Agent) -> Snapshot:
    """A copy of the agent's state."""
    return {name: _copied(value) for name, value in vars(agent.state).items() if name not in LEFT_OUT}


def put_back(agent: Agent, snapshot: Snapshot) -> None:
    """Let the agent be in the state of the snapshot. Its running timers have the deadline RUNNING_S."""
    state = vars(agent.state)
    state["now"] = NOW_S
    for name in HANDED_OVER & state.keys():
        state[name].clear()
    for name, value in snapshot.items():
        if isinstance(value, _TimerState | _ChainState):
            value.put_back(state[name])
        else:
            state[name] = _copied(value)


def key_of(snapshot: Snapshot, name_of: NameOf) -> tuple[Any, ...]:
    """Equal for equal states, and only for these."""
    return tuple(_keyed(value, name_of) for value in snapshot.values())


class _TimerState:
    __slots__ = ("paused", "running")

    def __init__(self, timer: Timer) -> None:
        self.running = timer.deadline is not None
        self.paused = timer.active and not self.running

    def put_back(self, timer: Timer) -> None:
        timer.stop()
        if self.running or self.paused:
            timer.start(RUNNING_S, 0.0)
        if self.paused:
            timer.pause(RUNNING_S)


class _ChainState:
    __slots__ = ("kind", "parts")

    def __init__(self, chain: Chain) -> None:
        self.kind = type(chain)
        self.parts = {name: _copied(value) for name, value in vars(chain).items() if name != "inception"}

    def put_back(self, chain: Chain) -> None:
        chain.__class__ = self.kind
        for name, value in self.parts.items():
            setattr(chain, name, _copied(value))


def _copied(value: Any) -> Any:
    """A copy that shares nothing that changes."""
    if value is None or isinstance(value, int | bytes | str | float | Block | _TimerState | _ChainState):
        return value
    if isinstance(value, Timer):
        return _TimerState(value)
    if isinstance(value, Chain):
        return _ChainState(value)
    if isinstance(value, Counter | set | bytearray):
        return value.copy()
    if isinstance(value, dict):
        return {key: _copied(item) for key, item in value.items()}
    if isinstance(value, list | deque | tuple):
        return type(value)(map(_copied, value))
    raise TypeError(f"an agent's state has a {type(value).__name__}, and nobody has said how it is copied")


def _keyed(value: Any, name_of: NameOf) -> Any:
    if isinstance(value, bytes):
        return name_of(value)
    if isinstance(value, Block):
        return name_of(value.block_hash)
    if isinstance(value, _TimerState):
        return value.running, value.paused
    if isinstance(value, _ChainState):
        return value.kind.__name__, *(_keyed(part, name_of) for part in value.parts.values())
    if isinstance(value, dict):
        return frozenset((_keyed(key, name_of), _keyed(item, name_of)) for key, item in value.items())
    if isinstance(value, set):
        return frozenset(_keyed(item, name_of) for item in value)
    if isinstance(value, bytearray):
        return bytes(value)
    if isinstance(value, list | deque | tuple):
        return tuple(_keyed(item, name_of) for item in value)
    return value
