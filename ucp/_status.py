"""Compute the part of an agent's status that follows from its protocol state (see contract/CONTRACT.md)."""

from ucp.agent import Agent


def status_of(agent: Agent) -> dict[str, object]:
    """Return the values of the status that follow from the agent's protocol state. The caller adds the other values."""
    state = agent.state
    return {
        "agent_id": agent.agent_id,
        "idle": state.idle,
        "reconcile_in_progress": state.reconcile_in_progress,
        "chain": len(state.chain),
        "deque": len(state.blocks_to_be_committed),
        "stack": len(state.reconcile_stack),
        "top_chain_hash": state.chain.top_chain_hash.hex(),
        "completed": len(state.completed),
        "reconciles": state.reconciles,
        "sent": dict(state.sent),
        "received": dict(agent.received),
        "dropped": dict(agent.dropped),
    }
