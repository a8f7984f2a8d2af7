"""Errors that a user meets: one clear sentence with the way out, and the exit status of the command line."""

import shlex
from collections.abc import Sequence
from typing import Self

VIOLATED, WRONG_REQUEST, CANNOT_HERE, INTERRUPTED = 1, 2, 3, 130
"""Exit statuses besides 0. 1: a characteristic is violated, or an agent failed; 2: scenario, arguments or exports are
wrong; 3: this machine cannot do it; 130: interrupted."""


class HarnessError(Exception):
    """The base of all errors that the harness raises for its users. The message is one sentence with the way out.

    `exit_status` is the exit status of the command line.
    """

    exit_status = WRONG_REQUEST
    details: Sequence[str] = ()
    """Further sentences, of one thing each, that are said before it."""


class ScenarioError(HarnessError):
    """A scenario or matrix is wrong, or does not suit what is to be done with it."""


class ExportError(HarnessError):
    """A chain export that cannot be used."""


class CaptureError(HarnessError):
    """A capture of packets that cannot be used."""


class RunDirectoryError(HarnessError):
    """The run directory cannot be written or read."""


class FieldError(HarnessError):
    """Nothing of what came home from the field can be used."""


class MachineError(HarnessError):
    """This machine cannot do what the user asked for, for example because a package is missing."""

    exit_status = CANNOT_HERE


class UnsupportedError(MachineError):
    """An agent under test says that it lacks what the run needs: it is neither right nor wrong."""

    @classmethod
    def of(cls, agent_id: int, command: Sequence[str], words: str) -> Self:
        """`words` are the agent's own, and may be none."""
        why = words.rstrip(".") or "it does not say why"
        return cls(f"not supported by agent {agent_id} ({shlex.join(command)}): {why}")


class AgentFailedError(HarnessError):
    """An agent under test crashed, hung, did not start, or gave an invalid answer.

    `outcome` says which, in a word. `detail` completes a sentence that starts with "agent 3".
    """

    exit_status = VIOLATED

    def __init__(self, agent_id: int, outcome: str, detail: str) -> None:
        super().__init__(f"agent {agent_id} {detail}")
        self.agent_id = agent_id
        self.outcome = outcome
        self.detail = detail


class InterruptedRunError(HarnessError):
    """The user asked to stop."""

    exit_status = INTERRUPTED
