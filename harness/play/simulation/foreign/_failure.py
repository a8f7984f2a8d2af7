"""How an agent that is not ours ends a mission in virtual time."""

from collections.abc import Sequence
from typing import Literal

from harness.errors import UnsupportedError

Outcome = Literal["crashed", "hung", "not supported"]


class AgentLacksError(UnsupportedError):
    """An agent says that it lacks what this mission needs, or cannot be driven in virtual time."""

    outcome: Outcome = "not supported"

    def __init__(self, agent_id: int, command: Sequence[str], words: str) -> None:
        super().__init__(str(UnsupportedError.of(agent_id, command, words)))
        self.agent_id = agent_id
        self.detail = str(self)
