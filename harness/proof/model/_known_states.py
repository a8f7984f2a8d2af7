"""Number all known states of single agents. Each state is checked for violations once, when it gets its number.

A local state is the complete state of a `ucp.agent.Agent` (`_snapshot.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from harness.proof.bounds import Bounds
from harness.proof.model._block_renaming import NumberedBlocks
from harness.proof.model._flaws import PropertyViolation, flaw_of, is_deceived
from harness.proof.model._snapshot import NAMES_OF_OTHERS, Snapshot, SnapshotParts, dead
from ucp.state import AgentState

DEAD = -1
"""The local state of a dead agent."""

FIRST, FIRST_OTHER = 1, 2
"""The ID that an agent uses for itself, and the first ID that it uses for the other agents, if states are stored
without agent IDs.
"""

Names = tuple[int, ...]
"""The IDs that one agent uses for the other agents, in the order of the other agents."""

WHAT_ONLY_CHECKS_READ: Snapshot = {"completed": [], "newest_block_timestamp_us": -1}
"""Parts of the state that no handler reads as long as no block is lost -> their initial values."""


@dataclass(frozen=True, slots=True)
class KnownLocalState:
    """A state of the agent with the ID `agent_id` that was found during the exploration."""

    agent_id: int
    snapshot: Snapshot
    running: tuple[int, ...]
    idle: bool
    waits: bool
    """True if the agent is in a reconcile."""
    chain: tuple[int, ...]
    """The numbers of the blocks in the agent's chain."""
    flaw: PropertyViolation | None
    anonymous: int
    """A number for the state that ignores which agents voted or answered. States that differ only in these agents have
    the same number. It is equal on all machines.
    """
    names_others: bool
    deceived: bool
    """True if the agent holds a block in the name of the captured vehicle that the captured vehicle never completed."""


class KnownStates:
    """An index of all known states of single agents.

    If `bounds.reduced` is true, states that differ only in irrelevant parts are one state. A part is irrelevant if
    every handler writes it before any handler reads it. docs/explanation/proof.md explains why this is sound.
    """

    def __init__(self, bounds: Bounds, blocks: NumberedBlocks) -> None:
        self.bounds = bounds
        self.blocks = blocks
        self.others = tuple(range(FIRST_OTHER, bounds.agents + 1))
        self.known: list[KnownLocalState] = []
        self.flawed: set[int] = set()
        """The numbers of states with a flaw."""
        self._nameless = bounds.nameless
        self._parts = SnapshotParts()
        self._numbers: dict[tuple[Any, ...], int] = {}
        self._renamed: dict[tuple[int, Names], int] = {}

    def number(self, agent_id: int, state: AgentState, taken: Snapshot, flaw: PropertyViolation | None) -> int:
        """Return the number of an agent's state. `taken` is the snapshot of the state."""
        snapshot = taken
        if self.bounds.reduced:
            forgotten = WHAT_ONLY_CHECKS_READ | dead(state)
            snapshot = snapshot | {
                name: self._parts.part(name, value) for name, value in forgotten.items() if snapshot[name] != value
            }
        key = self._parts.key(agent_id, flaw, snapshot)
        number = self._numbers.setdefault(key, len(self.known))
        if number == len(self.known):
            self.blocks.learn_chain(state.chain)
            self.known.append(
                KnownLocalState(
                    agent_id,
                    snapshot,
                    tuple(index for index, timer in enumerate(state.timers) if timer.deadline is not None),
                    state.idle,
                    state.reconcile_in_progress,
                    tuple(self._parts.name(block.block_hash) for block in state.chain),
                    flaw or flaw_of(state, self.blocks.makers, self.bounds.captured),
                    self._parts.anonymous(agent_id, flaw, snapshot),
                    self._names_others(snapshot),
                    is_deceived(state, self.blocks.makers, self.bounds.captured),
                )
            )
            if self.known[number].flaw is not None:
                self.flawed.add(number)
        return number

    def with_tallies(self, local: int, tallies: Snapshot) -> int:
        """Return the number of the state that results from this state with the vote counts `tallies`. All other parts
        stay equal.
        """
        known = self.known[local]
        snapshot = known.snapshot | {name: self._parts.part(name, value) for name, value in tallies.items()}
        key = self._parts.key(known.agent_id, known.flaw, snapshot)
        number = self._numbers.setdefault(key, len(self.known))
        if number == len(self.known):
            anonymous = self._parts.anonymous(known.agent_id, known.flaw, snapshot)
            names_others = self._names_others(snapshot)
            self.known.append(replace(known, snapshot=snapshot, anonymous=anonymous, names_others=names_others))
        return number

    # Names of other agents

    def renamed(self, local: int, names: Names) -> int:
        """Return the number of the state that results from this state with new IDs for the other agents."""
        if not self.known[local].names_others or self.known[local].flaw is not None:
            return local
        key = local, names
        number = self._renamed.get(key)
        if number is None:
            snapshot = self.known[local].snapshot
            new = dict(zip(self.others, names, strict=True))
            tallies = {name: {new[other] for other in snapshot[name]} for name in NAMES_OF_OTHERS}
            number = self._renamed[key] = self.with_tallies(local, tallies)
        return number

    def renamed_back(self, local: int, names: Names) -> int:
        """Return the number of the state before the method `renamed` replaced its IDs by `names`."""
        return self.renamed(local, _inverse(names))

    def names_in_order(self, local: int, sender: int) -> Names | None:
        """Return new IDs for the other agents in a fixed order: the agents whose votes or answers are counted are
        first, then the sender, then all others. Return None if the IDs are already in this order.

        If states are stored without agent IDs, an agent behaves in the same way with the new IDs
        (docs/explanation/proof.md).
        """
        known = self.known[local]
        if not self._nameless or known.flaw is not None:
            return None
        tallies = [known.snapshot[name] for name in NAMES_OF_OTHERS]
        in_order = sorted(self.others, key=lambda other: (*(other not in tally for tally in tallies), other != sender))
        return None if tuple(in_order) == self.others else _inverse(tuple(in_order))

    def first_names(self, local: int, senders: Sequence[int]) -> Names | None:
        """Return new IDs for the other agents that put these senders first, in their order. Return None if no change is
        needed.

        Also return None if the IDs must not change: the agent's vote counts distinguish other agents, the state has a
        flaw, or states are stored with agent IDs.
        """
        known = self.known[local]
        if not self._nameless or known.names_others or known.flaw is not None:
            return None
        in_order = tuple(dict.fromkeys((*senders, *self.others)))
        return None if in_order == self.others else _inverse(in_order)

    def _names_others(self, snapshot: Snapshot) -> bool:
        """Return true if the agent has counted the votes or answers of some other agents but not of all."""
        return any(0 < len(snapshot[name]) < len(self.others) for name in NAMES_OF_OTHERS)


def _inverse(names: Names) -> Names:
    """Return the new IDs that undo this renaming of agents."""
    before = {name: other for other, name in enumerate(names, FIRST_OTHER)}
    return tuple(before[name] for name in sorted(names))
