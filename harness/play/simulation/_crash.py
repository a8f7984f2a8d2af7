"""Decide whether an error during a simulation is the failure of an agent.

A foreign agent is a separate program, and its failures are errors of their own class. The harness's own agents run in
the process of the harness. An engineer edits their core in place, so an exception in the code of `ucp` counts as a
failure of the agent, like the crash of an agent's process. Any other exception is an error of the harness.
"""

from pathlib import Path
from traceback import extract_tb

import harness
import ucp
from harness.errors import AgentFailedError
from harness.play.simulation.incarnations import SimulatedIncarnation

CORE, HARNESS = Path(ucp.__file__).parent, Path(harness.__file__).parent
MAX_WORDS = 200


def agent_failure(incarnation: SimulatedIncarnation | None, error: Exception, at_s: float) -> AgentFailedError | None:
    """If an agent caused the error, return the failure of this agent. If the harness caused the error, return None.
    `incarnation` is the agent that was handling an input or a query at mission second `at_s`.
    """
    if isinstance(error, AgentFailedError):
        return error
    frames = [(Path(frame.filename), frame.lineno) for frame in extract_tb(error.__traceback__)]
    ours = [(path, line) for path, line in frames if path.is_relative_to(CORE) or path.is_relative_to(HARNESS)]
    if incarnation is None or incarnation.state is None or not ours or not ours[-1][0].is_relative_to(CORE):
        return None
    path, line = ours[-1]
    handler = vars(incarnation.state).get("running")
    where = f"in Algorithm {handler.algorithm}, {handler.name}, " if handler is not None else ""
    detail = (
        f"crashed at {at_s:g} s {where}at ucp/{path.relative_to(CORE)}:{line}: {type(error).__name__}: "
        f"{str(error)[:MAX_WORDS]}"
    )
    return AgentFailedError(incarnation.agent.agent_id, "crashed", detail)
