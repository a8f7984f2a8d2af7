"""Find the change of the code, or the agent, that changes how a scenario or a record plays.

A subject is a scenario, a run, or records of a flight (`outcome`). `code_state` checks out a commit in a clone of its
own, and runs processes with it. `_playing` plays the subject there and returns its outcome. `_bisecting` searches the
first commit whose outcome differs. Records are given to another commit's core in a process (`_record_core`), or to
another agent over UDP while its peers are played from a script (`_live_replay`, `_scripted_peers`).
"""

from harness.field.bisection._bisecting import Found, Tried, bisect
from harness.field.bisection._playing import CannotBeTriedError, Workshop
from harness.field.bisection.outcome import Outcome, Subject, differences, subject_of

__all__ = [
    "CannotBeTriedError",
    "Found",
    "Outcome",
    "Subject",
    "Tried",
    "Workshop",
    "bisect",
    "differences",
    "subject_of",
]
