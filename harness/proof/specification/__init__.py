"""Compare the agents with a second model: the TLA+ specification in ucp/contract/spec, which the program TLC checks.

See docs/explanation/specification.md.

`_tlc` runs TLC. `_second_opinion` explores the same bounds with `harness.proof` and with TLC, and compares the states,
which `_spec_states` writes in one form. `_validate` checks recorded runs against the specification, in the form that
`_recorded_incarnations` writes.
"""

from harness.proof.specification._second_opinion import SecondOpinion, second_opinion
from harness.proof.specification._validate import (
    RejectedStep,
    RunTraces,
    TraceValidation,
    recorded,
    simulated,
    validate,
)

__all__ = [
    "RejectedStep",
    "RunTraces",
    "SecondOpinion",
    "TraceValidation",
    "recorded",
    "second_opinion",
    "simulated",
    "validate",
]
