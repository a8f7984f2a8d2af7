"""Wrong agents: the faults of the thesis's tests, each a wrong handler in the place of a good one.

The good handlers know nothing of this. A wrong one mostly lets the good one run, and spoils what comes of it.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from random import Random
from typing import Any

from ucp.commit import receive_commit_block
from ucp.core import Core
from ucp.handler import EventHandler, in_place_of
from ucp.messages import BlockResponse, CommitBlock
from ucp.reconcile import (
    most_named,
    receive_response_block_for_hash,
    reconcile_phase_2_timer_expiration,
    reconcile_phase_3,
)


def ignores_commits(probability: float, lots: Random) -> EventHandler[[Core, int, CommitBlock]]:
    """Algorithm 6 ignores some Commit Blocks (Section 4.2, second stage of testing); `lots` decide which."""

    @in_place_of(receive_commit_block, "ignored by quirk")
    def ignores_some(core: Core, sender: int, message: CommitBlock) -> str:
        if not core.reconcile_in_progress and lots.random() < probability:
            return "ignored by quirk"
        return receive_commit_block.run(core, sender, message)

    return ignores_some


@in_place_of(reconcile_phase_2_timer_expiration, "tie: crashed by quirk")
def crashes_on_a_tie(core: Core) -> str:
    """Algorithm 15 dies on a tied vote, and the reconcile never ends (Section 4.3, second field test)."""
    if len(most_named(core.reconcile_response_dictionary)) > 1:
        return "tie: crashed by quirk"
    return reconcile_phase_2_timer_expiration.run(core)


@in_place_of(reconcile_phase_3)
def lets_phase_3_expire_early(core: Core) -> str:
    """The timer of Algorithm 16 ends as it starts, so no block ever comes in time (Section 4.3, agents 118 and 120)."""
    branch = reconcile_phase_3.run(core)
    if branch == "asked":
        core.start(core.phase_three_timer, 0.0)
    return branch


@in_place_of(receive_response_block_for_hash)
def keeps_a_stale_chain_hash(core: Core, sender: int, message: BlockResponse) -> str:
    """Algorithm 18 does not compute the chain hash anew (Section 4.2, the field tests' last bug)."""
    chain_hash_before = core.chain.top_chain_hash
    branch = receive_response_block_for_hash.run(core, sender, message)
    core.chain.top_chain_hash = chain_hash_before
    return branch


@dataclass(slots=True)
class Quirks:
    """Faults that an agent can be told to have while it runs."""

    ignore_commit: float = 0.0
    """The probability 0..1 of each Commit Block to be ignored."""
    crash_on_tie: bool = False
    early_phase3_expiry: bool = False
    stale_chain_hash: bool = False

    def set(self, name: str, value: Any) -> None:
        """Set one quirk by name. ValueError says which names there are and what the value may be."""
        known = [field.name for field in dataclasses.fields(self)]
        if name not in known:
            raise ValueError(f"unknown quirk {name!r}: there are {', '.join(known)}")
        if name == "ignore_commit":
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
                raise ValueError(f"ignore_commit is a probability 0..1, not {value!r}")
        elif not isinstance(value, bool):
            raise ValueError(f"{name} is true or false, not {value!r}")
        setattr(self, name, value)

    def handlers(self, lots: Random) -> Iterator[EventHandler[Any]]:
        """The wrong handlers of an agent with these faults; what is random is drawn from `lots`."""
        if self.ignore_commit > 0:
            yield ignores_commits(self.ignore_commit, lots)
        if self.crash_on_tie:
            yield crashes_on_a_tie
        if self.early_phase3_expiry:
            yield lets_phase_3_expire_early
        if self.stale_chain_hash:
            yield keeps_a_stale_chain_hash
