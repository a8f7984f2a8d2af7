"""What the arguments for the reductions (docs/proof.md) say that an agent never does: that it does is an error."""

from harness.proof.model._snapshot import Snapshot
from ucp.state import AgentState


class ReductionError(Exception):
    """The agent does what the argument for a reduction says that it never does."""


def check_that_nothing_is_lost(before: Snapshot, state: AgentState) -> None:
    """Blocks stay: without that the completed ones could not be forgotten (characteristic 2)."""
    held = {block.block_hash for name in ("blocks_to_be_committed", "reconcile_stack") for block in before[name]}
    held.update(before["chain"].parts["_block_of_hash"])
    if not all(state.holds(block_hash) for block_hash in held):
        raise ReductionError("a block that an agent held is gone: try again with --whole")
