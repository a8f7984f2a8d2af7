"""A second opinion: the specification in TLA+ (ucp/contract/spec), and what TLC, its model checker, says. See
docs/spec.md.

_tlc.py       whether TLC is here; a module given to it, and what it says
_spec_states.py  which settings of agents the specification has
_spec_states.py    a state of the specification, and one of the real agents, as the same tuple
_second_opinion.py   the same bounds looked at twice: by `harness.proof` and by TLC
_recorded_lives.py  lives of agents, written as the specification reads them
_validate.py  recorded runs held against the specification
"""

from harness.proof.specification._second_opinion import Opinion, second_opinion
from harness.proof.specification._validate import Recorded, Rejected, Validation, recorded, simulated, validate

__all__ = ["Opinion", "Recorded", "Rejected", "Validation", "recorded", "second_opinion", "simulated", "validate"]
