"""A second opinion: the specification in TLA+ (ucp/contract/spec), and what TLC, its model checker, says. See
docs/spec.md.

tlc.py       whether TLC is here; a module given to it, and what it says
spec_states.py  which settings of agents the specification has
spec_states.py    a state of the specification, and one of the real agents, as the same tuple
second_opinion.py   the same bounds looked at twice: by `harness.proof` and by TLC
recorded_lives.py  lives of agents, written as the specification reads them
validate.py  recorded runs held against the specification
"""

from harness.proof.specification.second_opinion import Opinion, second_opinion
from harness.proof.specification.validate import Recorded, Rejected, Validation, recorded, simulated, validate

__all__ = ["Opinion", "Recorded", "Rejected", "Validation", "recorded", "second_opinion", "simulated", "validate"]
