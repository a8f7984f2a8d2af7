"""Define errors for users, each with one sentence that names the cause and a solution, and its exit status."""

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Self

VIOLATED, WRONG_REQUEST, CANNOT_HERE, INCOMPLETE, INTERRUPTED = 1, 2, 3, 4, 130
"""Exit statuses other than 0. 1: a verdict is bad, an agent failed, or the result of a command is negative. 2: the
scenario, an argument or an input file is wrong. 3: this machine cannot run the command. 4: more time is needed for a
result. 130: interrupted. The docstring of `harness.cli` lists all statuses.
"""


class HarnessError(Exception):
    """The base class of all errors that users can cause. The message is one sentence with a solution.

    `exit_status` is the exit status of the command line.
    """

    exit_status = WRONG_REQUEST
    details: Sequence[str] = ()
    """Further sentences that the command line prints before the message, one for each problem."""


class ScenarioError(HarnessError):
    """An error: a scenario or matrix is wrong, or does not suit the requested command or backend."""


class ExportError(HarnessError):
    """An error: a chain export is missing, or cannot be read, written or used for the request."""


class CaptureError(HarnessError):
    """An error: a packet capture cannot be read."""


class RunDirectoryError(HarnessError):
    """An error: the run directory cannot be written or read."""


class FieldError(HarnessError):
    """An error: records of a flight cannot be used, or do not suit the request."""


class MachineError(HarnessError):
    """An error: this machine cannot fulfil the request, for example because a package is missing."""

    exit_status = CANNOT_HERE


@contextmanager
def extra(name: str, purpose: str) -> Iterator[None]:
    """Import the optional packages of the extra `name` inside the context.

    Raises MachineError with the install command if a package is missing. `purpose` names the command or option that
    needs the package. It is the subject of the error message.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        why = f"{purpose} needs the package {error.name}: run `pip install 'ucp-harness[{name}]'`"
        raise MachineError(why) from None


class UnsupportedError(MachineError):
    """An error: an agent under test lacks a feature that the run needs. The run is not judged."""

    @classmethod
    def of(cls, agent_id: int, command: Sequence[str], words: str) -> Self:
        """Return the error for an agent. `words` is the message that the agent printed, which may be empty."""
        why = words.rstrip(".") or "it does not say why"
        return cls(f"not supported by agent {agent_id} ({shlex.join(command)}): {why}")


class AgentFailedError(HarnessError):
    """An error: an agent under test crashed, hung, could not be started, or gave an invalid answer.

    `outcome` names the kind of failure in one word. `detail` completes a sentence that starts with "agent 3".
    """

    exit_status = VIOLATED

    def __init__(self, agent_id: int, outcome: str, detail: str) -> None:
        super().__init__(f"agent {agent_id} {detail}")
        self.agent_id = agent_id
        self.outcome = outcome
        self.detail = detail


class InterruptedRunError(HarnessError):
    """An error: the user interrupted the run."""

    exit_status = INTERRUPTED
