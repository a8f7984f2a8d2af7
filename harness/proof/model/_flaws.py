"""Find violations that the state of a single agent shows."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from ucp.block import next_chain_hash
from ucp.state import AgentState


@dataclass(frozen=True, slots=True)
class PropertyViolation:
    """A violation: its kind, and a sentence that describes it. `handler` is the handler of a wrong step.

    The kind is a characteristic ("2", "3", "4"), "hang", "crash" or "steps". With an attacker, there are three further
    kinds:

    - "name": an agent accepted a message in the name of a vehicle that did not send it.
    - "revoked": an agent accepted a message of a revoked vehicle.
    - "honest": an agent holds a block in the name of an honest vehicle that did not complete it.
    """

    kind: str
    sentence: str
    handler: str | None = None


FLAWS_OF_STEPS = ("crash", "steps", "name", "revoked")
"""Kinds of violations that only the step itself shows. The state after the step does not show them."""


def flaw_of(state: AgentState, completed: Mapping[bytes, int], captured: int | None) -> PropertyViolation | None:
    """Return the violation in an agent's state. Return None if the state has no violation.

    `completed` maps the hash of each completed block to the agent that completed it. Blocks in the name of the
    `captured` agent need not have been completed.
    """
    aside = [block.block_hash for block in (*state.blocks_to_be_committed, *state.reconcile_stack)]
    chain = [block.block_hash for block in state.chain]
    if state.idle and (aside or not {*state.completed} <= {*chain}):
        return PropertyViolation("2", "an idle agent holds a completed block that is not in its chain")
    if any(count > 1 for count in Counter([*chain, *aside]).values()):
        return PropertyViolation("3", "an agent holds a block twice")
    if any(completed.get(made) != maker != captured for made, maker in _makers(state).items()):
        kind = "4" if captured is None else "honest"
        return PropertyViolation(kind, "an agent holds a block that its named maker never completed")
    chain_hash = state.chain.inception.chain_hash
    for block, said in state.chain.with_chain_hashes():
        chain_hash = next_chain_hash(chain_hash, block.block_hash)
        if said != chain_hash:
            return PropertyViolation("4", "a chain hash does not match the blocks up to it")
    if state.reconcile_in_progress and all(timer.deadline is None for timer in state.reconcile_timers):
        return PropertyViolation(
            "hang", "an agent reconciles, but no timer of the reconcile runs: it never answers another agent again"
        )
    return None


def is_deceived(state: AgentState, completed: Mapping[bytes, int], captured: int | None) -> bool:
    """Return true if the agent holds a block that names the captured agent, although the captured agent never completed
    it.
    """
    if captured is None:
        return False
    return any(maker == captured and made not in completed for made, maker in _makers(state).items())


def _makers(state: AgentState) -> dict[bytes, int]:
    """Block hash -> the agent that the block names as its author, for each block that an agent holds."""
    held = (*state.chain, *state.blocks_to_be_committed, *state.reconcile_stack)
    return {block.block_hash: block.agent_id for block in held}
