"""Detect that an agent crashed although it runs in the harness's own process.

An engineer edits the core in place, and in virtual time the core runs in the process of the harness. An exception that
comes out of `ucp` is a failure of the agent, like the end of an agent's process. Any other exception is an error of the
harness.
"""

from pathlib import Path
from traceback import extract_tb

import harness
import ucp
from harness.errors import AgentFailedError
from harness.play.simulation.incarnations import SimulatedIncarnation

CORE, HARNESS = Path(ucp.__file__).parent, Path(harness.__file__).parent
MAX_WORDS = 200


def core_crash(incarnation: SimulatedIncarnation | None, error: Exception) -> AgentFailedError | None:
    """Return the failure of the agent if its own code raised the exception. Return None if code of the harness raised
    it.
    """
    frames = [(Path(frame.filename), frame.lineno) for frame in extract_tb(error.__traceback__)]
    ours = [(path, line) for path, line in frames if path.is_relative_to(CORE) or path.is_relative_to(HARNESS)]
    if incarnation is None or incarnation.state is None or not ours or not ours[-1][0].is_relative_to(CORE):
        return None
    path, line = ours[-1]
    handler = vars(incarnation.state).get("running")
    where = f"in Algorithm {handler.algorithm}, {handler.name}, " if handler is not None else ""
    detail = f"crashed {where}at ucp/{path.relative_to(CORE)}:{line}: {type(error).__name__}: {str(error)[:MAX_WORDS]}"
    return AgentFailedError(incarnation.agent.agent_id, "crashed", detail)
