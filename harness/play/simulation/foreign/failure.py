"""How an agent that is not ours ends a mission in virtual time."""

from typing import Literal

from harness.errors import VIOLATED, WRONG_REQUEST, HarnessError

Outcome = Literal["crashed", "hung"]


class AgentFailedError(HarnessError):
    """An agent crashed, hung, or answered what is no answer: the thing under test failed."""

    exit_status = VIOLATED

    def __init__(self, agent_id: int, outcome: Outcome, detail: str) -> None:
        super().__init__(f"agent {agent_id} {detail}")
        self.agent_id = agent_id
        self.outcome = outcome
        self.detail = detail


class NotSupportedError(HarnessError):
    """An agent says that it cannot do what this mission needs, or cannot be driven in virtual time."""

    exit_status = WRONG_REQUEST
