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
from ucp.state import AgentState
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


def dead(state: AgentState) -> Snapshot:
    """What every handler of a right agent writes before it reads it again, as it is at the beginning."""
    parts: Snapshot = {}
    if not state.voting_timer.active:
        parts["vote_count"] = {"yes": 0, "no": 0}
        parts["voters"] = set()
        parts["candidate_block"] = None
        parts["top_chain_hash_at_initiation"] = b""
    if not state.phase_one_timer.active:
        parts["reconcile_vote_count"] = {"yes": 0, "no": 0}
        if not state.phase_two_timer.active:
            parts["reconcile_responders"] = set()
    if not state.phase_two_timer.active:
        parts["reconcile_response_dictionary"] = {}
    if not state.phase_three_timer.active:
        parts["majority_response_block_hash"] = None
    return parts


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


def is_as(agent: Agent, snapshot: Snapshot) -> bool:
    """Whether the agent, which was in the state of the snapshot, still is."""
    state = vars(agent.state)
    for name, value in snapshot.items():
        if isinstance(value, _TimerState | _ChainState):
            if not value.is_of(state[name]):
                return False
        elif state[name] != value:
            return False
    return state.keys() - LEFT_OUT == snapshot.keys()


def key_of(snapshot: Snapshot, name_of: NameOf) -> tuple[Any, ...]:
    """Equal for equal states, and only for these."""
    return tuple(_keyed(value, name_of) for value in snapshot.values())


class _TimerState:
    __slots__ = ("paused", "running")

    def __init__(self, timer: Timer) -> None:
        self.running = timer.deadline is not None
        self.paused = timer.active and not self.running

    def is_of(self, timer: Timer) -> bool:
        """A timer that was started anew is not what it was."""
        return (timer.deadline == RUNNING_S) == self.running and timer.active == (self.running or self.paused)

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

    def is_of(self, chain: Chain) -> bool:
        now = vars(chain)
        return type(chain) is self.kind and all(now[name] == value for name, value in self.parts.items())

    def put_back(self, chain: Chain) -> None:
        chain.__class__ = self.kind
        for name, value in self.parts.items():
            setattr(chain, name, _copied(value))


def _copied(value: Any) -> Any:
    """A copy that shares nothing that changes."""
    copy = _COPIED.get(type(value))
    if copy is None:
        copy = next((way for kind, way in _COPIED.items() if isinstance(value, kind)), None)
    if copy is None:
        raise TypeError(f"an agent's state has a {type(value).__name__}, and nobody has said how it is copied")
    return copy(value)


def _itself(value: Any) -> Any:
    return value


def _each(value: Any) -> Any:
    return type(value)(map(_copied, value))


_COPIED: dict[type, Callable[[Any], Any]] = {
    **dict.fromkeys((type(None), bool, int, bytes, str, float, Block, _TimerState, _ChainState), _itself),
    **dict.fromkeys((set, bytearray, Counter), lambda value: value.copy()),
    **dict.fromkeys((list, deque, tuple), _each),
    dict: lambda value: {key: _copied(item) for key, item in value.items()},
    Timer: _TimerState,
    Chain: _ChainState,
}


def _keyed(value: Any, name_of: NameOf) -> Any:
    key = _KEYED.get(type(value))
    return value if key is None else key(value, name_of)


_KEYED: dict[type, Callable[[Any, NameOf], Any]] = {
    bytes: lambda value, name_of: name_of(value),
    Block: lambda value, name_of: name_of(value.block_hash),
    _TimerState: lambda value, name_of: (value.running, value.paused),
    _ChainState: lambda value, name_of: (
        value.kind.__name__,
        *[_keyed(part, name_of) for part in value.parts.values()],
    ),
    dict: lambda value, name_of: frozenset(
        [(_keyed(key, name_of), _keyed(item, name_of)) for key, item in value.items()]
    ),
    set: lambda value, name_of: frozenset([_keyed(item, name_of) for item in value]),
    bytearray: lambda value, name_of: bytes(value),
    **dict.fromkeys((list, deque, tuple), lambda value, name_of: tuple([_keyed(item, name_of) for item in value])),
}
