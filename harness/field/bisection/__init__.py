"""Find the commit that changed the behaviour of the agents.

The package runs a scenario, or replays a run or the records of a flight, with the code of several commits, and compares
the results. It can also compare two agent programs in this way. The module `outcome` calls the scenario, run or records
the *subject* of the search. `harness.run.code_state` checks out a commit in a separate clone, and runs processes with
it. `_playing` runs or replays the subject with this commit and returns the outcome. `_bisecting` searches for the first
commit with a different outcome. Records are replayed either by the core of another commit in a separate process
(`_record_core`), or by another agent program over UDP with scripted peers (`_live_replay`, `_scripted_peers`).
"""

from harness.field.bisection._bisecting import BisectionResult, CommitTrial, bisect
from harness.field.bisection._playing import SubjectPlayer, UntestableError
from harness.field.bisection.outcome import BisectionSubject, Outcome, differences, subject_of

__all__ = [
    "BisectionResult",
    "BisectionSubject",
    "CommitTrial",
    "Outcome",
    "SubjectPlayer",
    "UntestableError",
    "bisect",
    "differences",
    "subject_of",
]
