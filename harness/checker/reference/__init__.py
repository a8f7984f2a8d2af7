"""The independent implementation of the protocol. The checker compares each step of an agent with this implementation.

The module `algorithms` is a transcription of Algorithms 1-20. The author of the module worked from the thesis and from
`docs/reference/readings.md`, which interprets the ambiguous passages of the thesis, and did not see `ucp`. The two
implementations share only the message codec and the hashes. An edit of `ucp` therefore changes the agents, but not the
judge.
"""

from collections.abc import Container

from ucp.messages import CARRY_A_BLOCK, Message


def why_not_handled(agent_id: int, roster: Container[int], sender: int, message: Message) -> str | None:
    """Return the reason why an agent drops this valid message. Return None if the agent handles it."""
    if sender == agent_id:
        return "own sender"
    if sender not in roster:
        return "sender not on the roster"
    if type(message) in CARRY_A_BLOCK and message.block.agent_id not in roster:  # type: ignore[union-attr]
        return "block not of the roster"
    return None
