"""It worked last week: what came of a scenario or a record with another state of the code, or with another agent.

outcome.py      what is played: a scenario, a run that is played again, or records from the field
outcome.py      what came of it, and in what two outcomes differ
code_state.py         a directory with a state of the code, and what runs in it
_playing.py      the subject, played with a state of the code or with an agent command
_live_replay.py         a record that is given to an agent as a process, by UDP
_scripted_peers.py        the process that plays all its peers
_record_core.py  the process in which another state's core is given records
code_state.py      the commits between a good one and a bad one, in a clone that nobody else sees
_bisecting.py    the first commit at which the outcome changes
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
