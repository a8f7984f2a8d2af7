"""Store the complete state of an agent as a snapshot, and describe steps between snapshots. Snapshots share equal
parts.

The key of a snapshot omits only parts that never affect the agent's behaviour: the time of its last input, counters
that are only reported, and its pending output. All other attributes of `ucp.state.AgentState` are in the key, including
attributes of future versions. A value of an unknown type is an error and is never omitted.
"""

from collections import Counter, deque
from collections.abc import Callable
from hashlib import blake2b
from typing import Any, NamedTuple

from harness.proof.model._flaws import PropertyViolation
from ucp.agent import ON_MESSAGE, Agent
from ucp.block import Block
from ucp.chain import Chain
from ucp.state import AgentState
from ucp.timers import Timer

REPORTED = frozenset(("now", "sent", "reconciles", "chain_changed_at", "_sequence"))
"""Counters and notes that are needed only for a trace or for the sequence number of a datagram.

They grow without limit, so they cannot be part of a state. At the beginning of each step, the counters are zero, and
the mission second is `NOW_S`. An unreduced proof repeats each step with other counters and at other times, and refuses
an agent whose step depends on them.
"""
COUNTS = ("reconciles", "_sequence", "chain_changed_at")
"""The attributes in `REPORTED` that are counters and that no input sets."""
FIXED = frozenset(("agent_id", "settings", "timers", "reconcile_timers", "running", "_tracing", "_seal", "sealed"))
"""Attributes that need not be in a snapshot. Some never change. Some refer to the same objects as other attributes of
the snapshot. `_seal` and `sealed` are unused, because explored agents do not encrypt events.
"""
HANDED_OVER = frozenset(("outbox", "changes", "announced", "started"))
LEFT_OUT = REPORTED | FIXED | HANDED_OVER

NOW_S = 1000.0
"""The mission second at which each step is computed. It is the same for all steps, because zones store the remaining
times of timers.
"""
RUNNING_S = 1e15
"""The deadline that a timer gets in a computed step if it was running before the input."""

MESSAGE_NAMES = tuple(message.NAME for message in ON_MESSAGE)

Snapshot = dict[str, Any]
NameOf = Callable[[bytes], int]
"""A function that returns a number for a hash, always the same for the same hash."""


_DEAD_VOTE: Snapshot = {
    "vote_count": {"yes": 0, "no": 0},
    "voters": set(),
    "candidate_block": None,
    "top_chain_hash_at_initiation": b"",
}
_DEAD_PHASE_1: Snapshot = {"reconcile_vote_count": {"yes": 0, "no": 0}}
_DEAD_RESPONDERS: Snapshot = {"reconcile_responders": set()}
_DEAD_PHASE_2: Snapshot = {"reconcile_response_dictionary": {}}
_DEAD_PHASE_3: Snapshot = {"majority_response_block_hash": None}


def take(agent: Agent, like: Snapshot | None = None) -> Snapshot:
    """Return a snapshot of the agent's state. To save memory, it shares all parts that are equal in the snapshot
    `like`.
    """
    state = vars(agent.state)
    if like is None:
        return {name: _copied(value) for name, value in state.items() if name not in LEFT_OUT}
    return {
        name: like[name] if name in like and _is_part(like[name], value) else _copied(value)
        for name, value in state.items()
        if name not in LEFT_OUT
    }


def dead(state: AgentState) -> Snapshot:
    """Return the parts of the state that have no effect, with their initial values. Every handler of a correct agent
    writes these parts before any handler reads them.
    """
    parts: Snapshot = {}
    if not state.voting_timer.active:
        parts |= _DEAD_VOTE
    if not state.phase_one_timer.active:
        parts |= _DEAD_PHASE_1
        if not state.phase_two_timer.active:
            parts |= _DEAD_RESPONDERS
    if not state.phase_two_timer.active:
        parts |= _DEAD_PHASE_2
    if not state.phase_three_timer.active:
        parts |= _DEAD_PHASE_3
    return parts


def put_back(agent: Agent, snapshot: Snapshot, since: Snapshot | None = None) -> None:
    """Set the agent to the state of a snapshot. Each running timer of the agent gets the deadline RUNNING_S.

    `since` is the agent's current state if it is known. Parts that are the same objects in `since` and in the snapshot
    are not changed.
    """
    state = vars(agent.state)
    set_counts(agent, 0, NOW_S)
    for name in HANDED_OVER.intersection(state):
        state[name].clear()
    for name in [name for name in state if name not in snapshot and name not in LEFT_OUT]:
        del state[name]  # an attribute that a handler adds later
    for name, value in snapshot.items():
        if since is not None and name in since and since[name] is value:
            continue
        if isinstance(value, _TimerState | _ChainState):
            value.put_back(state[name])
        else:
            state[name] = _copied(value)


def set_counts(agent: Agent, count: int, now_s: float) -> None:
    """Set all counters of the agent to `count`, and its time to `now_s`. The steps of agents that a proof covers do not
    depend on these values.
    """
    state = vars(agent.state)
    state["now"] = now_s
    state.update(dict.fromkeys(COUNTS, count))
    state["sent"] = Counter(dict.fromkeys(MESSAGE_NAMES, count) if count else ())


def reverse_dictionaries(agent: Agent) -> None:
    """Reverse the order of each dictionary in the agent's state. The key of a state does not contain this order, so no
    step may depend on it.
    """
    state = vars(agent.state)
    state.update({name: dict(reversed(value.items())) for name, value in state.items() if type(value) is dict})


def _is_part(part: Any, value: Any) -> bool:
    """Return true if `value` equals `part`, a stored part of a state."""
    if isinstance(part, _TimerState | _ChainState):
        return part.is_of(value)
    return bool(part == value)


def replaced(value: Any, hash_of: Callable[[bytes], bytes], block_of: Callable[[Block], Block]) -> Any:
    """Return a part of the state with replaced hashes and blocks. `hash_of` and `block_of` return the replacements."""
    if isinstance(value, bytes):
        return hash_of(value)
    if isinstance(value, Block):
        return block_of(value)
    if isinstance(value, _ChainState):
        return value.replaced(hash_of, block_of)
    if isinstance(value, dict):
        return {replaced(key, hash_of, block_of): replaced(item, hash_of, block_of) for key, item in value.items()}
    if isinstance(value, list | deque | tuple | set):
        return type(value)(replaced(item, hash_of, block_of) for item in value)
    return value


def keyed(value: Any, name_of: NameOf) -> Any:
    """Return a part of the state as nested tuples of numbers. Equal parts give equal results on all machines."""
    key = _KEYED.get(type(value))
    return value if key is None else key(value, name_of)


def key_of(snapshot: Snapshot, name_of: NameOf) -> tuple[Any, ...]:
    """Return a key of a state. Different states have different keys, and equal states have equal keys."""
    return tuple(keyed(value, name_of) for value in snapshot.values())


class _TimerState:
    __slots__ = ("paused", "running")

    def __init__(self, timer: Timer) -> None:
        self.running = timer.deadline is not None
        self.paused = timer.active and not self.running

    @property
    def active(self) -> bool:
        return self.running or self.paused

    def is_of(self, timer: Timer) -> bool:
        """Return true if the timer is unchanged. A timer that was started again counts as changed."""
        return (timer.deadline == RUNNING_S) == self.running and timer.active == (self.running or self.paused)

    def put_back(self, timer: Timer) -> None:
        timer.stop()
        if self.running or self.paused:
            timer.start(RUNNING_S, 0.0)
        if self.paused:
            timer.pause(RUNNING_S)


class _ChainState:
    __slots__ = ("kind", "parts")

    def __init__(self, kind: type[Chain], parts: dict[str, Any]) -> None:
        self.kind = kind
        self.parts = parts

    @classmethod
    def of(cls, chain: Chain) -> "_ChainState":
        parts = {name: _copied(value) for name, value in vars(chain).items() if name != "inception"}
        return cls(type(chain), parts)

    def is_of(self, chain: Chain) -> bool:
        now = vars(chain)
        return type(chain) is self.kind and all(now[name] == value for name, value in self.parts.items())

    def put_back(self, chain: Chain) -> None:
        chain.__class__ = self.kind
        for name, value in self.parts.items():
            setattr(chain, name, _copied(value))

    def replaced(self, hash_of: Callable[[bytes], bytes], block_of: Callable[[Block], Block]) -> "_ChainState":
        parts = {name: replaced(value, hash_of, block_of) for name, value in self.parts.items()}
        return _ChainState(self.kind, parts)


def _copied(value: Any) -> Any:
    """Return a copy that shares no mutable object with the original."""
    copy = _COPIED.get(type(value))
    if copy is None:
        copy = next((copier for kind, copier in _COPIED.items() if isinstance(value, kind)), None)
    if copy is None:
        raise TypeError(
            f"an agent's state has a {type(value).__name__}, which the prover cannot copy: add its type to _COPIED"
        )
    return copy(value)


def _unchanged(value: Any) -> Any:
    return value


def _copied_items(value: Any) -> Any:
    return type(value)(map(_copied, value))


_COPIED: dict[type, Callable[[Any], Any]] = {
    **dict.fromkeys((type(None), bool, int, bytes, str, float, Block, _TimerState, _ChainState), _unchanged),
    **dict.fromkeys((set, bytearray, Counter), lambda value: value.copy()),
    **dict.fromkeys((list, deque, tuple), _copied_items),
    dict: lambda value: {key: _copied(item) for key, item in value.items()},
    Timer: _TimerState,
    Chain: _ChainState.of,
}


_KEYED: dict[type, Callable[[Any, NameOf], Any]] = {
    bytes: lambda value, name_of: name_of(value),
    Block: lambda value, name_of: name_of(value.block_hash),
    _TimerState: lambda value, name_of: (value.running, value.paused),
    _ChainState: lambda value, name_of: (
        value.kind.__name__,
        *[keyed(part, name_of) for part in value.parts.values()],
    ),
    dict: lambda value, name_of: tuple(
        sorted([(keyed(key, name_of), keyed(item, name_of)) for key, item in value.items()])
    ),
    set: lambda value, name_of: tuple(sorted([keyed(item, name_of) for item in value])),
    bytearray: lambda value, name_of: bytes(value),
    **dict.fromkeys((list, deque, tuple), lambda value, name_of: tuple([keyed(item, name_of) for item in value])),
}


Started = tuple[tuple[int, int], ...]
"""The timers that an agent has started in this instant and that are running, each as (number, duration in
microseconds).
"""


class AgentStep(NamedTuple):
    """The result of an input to an agent: the new state, the sent messages, and the started timers."""

    local: int
    sent: tuple[int, ...]
    started: Started


class TimerResult(NamedTuple):
    """A possible result when a timer expires. If `oldest` is given, it is a candidate of phase 2, and the result occurs
    only if this candidate is the oldest one.
    """

    step: AgentStep
    oldest: bytes | None


NAMES_OF_OTHERS = ("voters", "reconcile_responders")
"""Parts of the state that are sets of other agents' IDs."""


class SnapshotParts:
    """A store of the parts of all known states, in which equal parts exist once."""

    def __init__(self) -> None:
        self._parts: dict[tuple[str, Any], Any] = {}
        self._numbers: dict[int, int] = {}
        """`id` of a part -> number of the part."""
        self._digests: dict[int, bytes] = {}
        """`id` of a part -> digest, which is equal on all machines."""
        self._hashes: dict[int, bytes] = {}

    def part(self, name: str, value: Any) -> Any:
        """Return the stored part that is equal to the given part."""
        key = name, keyed(value, self.name)
        part = self._parts.setdefault(key, value)
        if part is value:
            self._numbers.setdefault(id(part), len(self._numbers))
            self._digests[id(part)] = blake2b(repr(key[1]).encode(), digest_size=8).digest()
        return part

    def of(self, snapshot: Snapshot, like: Snapshot) -> Snapshot:
        """Return the state `snapshot`, in which each part is replaced by the equal stored part. Parts that are the same
        objects in `like` are already stored.
        """
        return {
            name: value if like.get(name, self) is value else self.part(name, value) for name, value in snapshot.items()
        }

    def key(self, agent_id: int, flaw: PropertyViolation | None, snapshot: Snapshot) -> tuple[Any, ...]:
        """Return a key of a state whose parts are all stored. Equal states have equal keys."""
        numbers = self._numbers
        return (agent_id, flaw, *[numbers[id(part)] for part in snapshot.values()])

    def anonymous(self, agent_id: int, flaw: PropertyViolation | None, snapshot: Snapshot) -> int:
        """Return a number for a state. States that differ only in which agents voted or answered have the same number.
        The number is the same on all machines.
        """
        parts = [
            len(value) if name in NAMES_OF_OTHERS else self._digests[id(value)] for name, value in snapshot.items()
        ]
        return int.from_bytes(blake2b(repr((agent_id, flaw, parts)).encode(), digest_size=8).digest())

    def name(self, digest: bytes) -> int:
        """Return a number for a hash. The number is the same on all machines."""
        name = int.from_bytes(digest[:8])
        assert self._hashes.setdefault(name, digest) == digest, "no two hashes that there are begin alike"
        return name


class UncoveredError(Exception):
    """An error: the agent depends on data that are not part of a state, so no proof can cover it."""


class ReductionError(Exception):
    """An error: the agent breaks an assumption that allows states to be merged."""


def check_that_nothing_is_lost(before: Snapshot, state: AgentState) -> None:
    """Raise ReductionError if the agent has lost a block.

    States omit the list of completed blocks. This is correct only if agents never lose a block (characteristic 2).
    """
    held = {block.block_hash for name in ("blocks_to_be_committed", "reconcile_stack") for block in before[name]}
    held.update(before["chain"].parts["_block_of_hash"])
    if not all(state.holds(block_hash) for block_hash in held):
        raise ReductionError("a block of an agent has disappeared: try again with --whole")
