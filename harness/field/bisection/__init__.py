"""~Find the commit that changed the result of a scenario or of a record. Also compare two agent programs in this way. A
subject is a scenario, a run, or the records of a flight (`outcome`).~Find the commit that changed the behaviour of the
agents. The package plays a scenario, a run or the records of a flight with the code of several commits, and compares
the results. It can also compare two agent programs in this way. The module `outcome` calls the scenario, run or records
the *subject* of the search.
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
