"""Compute the shares of an agent's existing states and inputs that runs have reached."""

from collections.abc import Iterator
from dataclasses import dataclass

from harness.proof._progress_bar import Ended
from harness.proof.bounds import Bounds
from harness.proof.coverage.reached import BRANCHES, Branch, ReachedStates
from harness.proof.graph._exploration import explore
from harness.proof.model._any_sender import collect
from harness.proof.model._global_states import ModelSwarm
from harness.proof.model._known_states import DEAD
from harness.proof.model._local_steps import LocalStates
from harness.proof.model._shape import HeldBlockOrder, Shape, shape_of


@dataclass
class ExistingStates:
    """The states of an agent, and the pairs of a state and an input, that exist within the bounds of a proof. The
    object contains all of them only if `ended` is "complete".
    """

    bounds: Bounds
    states: set[int]
    pairs: set[int]
    ended: Ended = "complete"


def existing(bounds: Bounds, *, most_bytes: float = 4e9, most_s: float = float("inf")) -> ExistingStates:
    """Return all agent states and (state, input) pairs within the bounds. If the search reaches a limit of memory or
    time, return the states and pairs that were found before the limit.
    """
    there = ExistingStates(bounds, set(), set())
    if bounds.network == "any":
        collected = collect(bounds, most_bytes=most_bytes, most_s=most_s, keep=lambda local: _add(there, local))
        there.ended = collected.ended
    else:
        swarm = ModelSwarm(bounds, every_count=True)
        there.ended = explore(swarm, most_bytes=most_bytes, most_s=most_s).ended
        _add(there, swarm.local)
    return there


def _add(there: ExistingStates, local: LocalStates) -> None:
    shapes: list[tuple[HeldBlockOrder, Shape, int]] = []
    for number in range(len(local.known)):
        state = local.state(number)
        held = HeldBlockOrder(state)
        shape = shape_of(state, held)
        shapes.append((held, shape, held.number(shape)))
    there.states.update(number for _, _, number in shapes)
    for before, given, step in local.inputs():
        held, shape, number = shapes[before]
        if step.local == DEAD or (shapes[step.local][2] == number and not step.sent):
            continue
        if isinstance(given, str):
            there.pairs.add(held.number((shape, ("timer", given))))
        else:
            there.pairs.add(held.number((shape, ("event",) if given is None else held.input_shape(given))))


SCHEMA = "ucp-coverage/1"


@dataclass(frozen=True)
class CoverageShare:
    """The coverage of states, inputs or branches: the number of reached ones within the bounds of a proof, the number
    that exist within these bounds, and the number of reached ones beyond the bounds.
    """

    reached: int
    exist: int
    beyond: int

    @classmethod
    def of(cls, reached: set[int], existing: set[int]) -> "CoverageShare":
        inside = len(reached & existing)
        return cls(inside, len(existing), len(reached) - inside)

    @property
    def percent(self) -> str:
        """The share as text, for example "35 %". Only exact shares are printed as 0 % or 100 %."""
        if self.reached == self.exist:
            return "100 %"
        if self.reached == 0:
            return "0 %"
        share = 100 * self.reached / self.exist
        return f"{min(max(share, 0.1), 99.9):.1f} %" if share < 1 or share > 99 else f"{share:.0f} %"

    def in_words(self, what: str) -> str:
        """Return text such as "199 of 568 local states (35 %), 12 beyond the bounds"."""
        return f"{self.reached:,} of {self.exist:,} {what} ({self.percent}), {self.beyond:,} beyond the bounds"

    def to_json(self) -> dict[str, int]:
        return {"reached": self.reached, "exist": self.exist, "beyond": self.beyond}


def not_taken(reached: ReachedStates) -> list[Branch]:
    """Return the branches of handlers in the agent contract that no run has taken."""
    return [branch for branch in BRANCHES if not reached.branches[branch]]


def to_json(reached: ReachedStates, there: ExistingStates | None) -> dict[str, object]:
    """Return the coverage as a JSON document. If the existing states and pairs are given (`there`), the document also
    contains the share of existing states and pairs that the runs reached.
    """
    missing = not_taken(reached)
    document = {
        "schema": SCHEMA,
        "handler_runs": reached.steps,
        "local_states": len(reached.states),
        "pairs": len(reached.pairs),
        "branches": {
            "taken": len(BRANCHES) - len(missing),
            "exist": len(BRANCHES),
            "not_taken": [list(branch) for branch in missing],
        },
        "untold": reached.untold,
    }
    if there is None:
        return document
    bounds = there.bounds
    return {
        **document,
        "within": {
            "agents": bounds.agents,
            "blocks": bounds.blocks,
            "network": bounds.network,
            "faults": list(bounds.faults),
            "settings": dict(bounds.settings),
            "complete": there.ended == "complete",
            "local_states": CoverageShare.of(reached.states, there.states).to_json(),
            "pairs": CoverageShare.of(reached.pairs, there.pairs).to_json(),
        },
    }


def in_words(reached: ReachedStates, there: ExistingStates | None) -> Iterator[str]:
    """Yield lines of text about the coverage."""
    yield (
        f"{reached.steps:,} handler runs: {len(reached.states):,} local states, {len(reached.pairs):,} pairs of one "
        f"with an input"
    )
    if there is not None:
        yield f"share of the states within {there.bounds.in_words()}:"
        if there.ended != "complete":
            yield f"  the state space is incomplete ({there.ended}), so the shares are too large"
        yield f"  {CoverageShare.of(reached.states, there.states).in_words('local states')}"
        yield f"  {CoverageShare.of(reached.pairs, there.pairs).in_words('pairs')}"
    missing = not_taken(reached)
    yield f"{len(BRANCHES) - len(missing)} of {len(BRANCHES)} branches of the 20 handlers"
    by_handler: dict[str, list[str]] = {}
    for handler, branch in missing:
        by_handler.setdefault(handler, []).append(branch)
    for handler, branches in by_handler.items():
        yield f"  not taken: {handler}: {', '.join(branches)}"
    if reached.untold:
        yield f"some steps are unknown: {reached.untold}"
