"""Compare the agents with a second model: the TLA+ specification in ucp/contract/spec, which the program TLC checks.

See docs/explanation/specification.md.

`_tlc` runs TLC. `_second_opinion` explores the same bounds with `harness.proof` and with TLC, and compares the states.
`_spec_states` converts the states of both to the same form. `_validate` checks recorded runs against the specification.
`_recorded_incarnations` encodes these runs for TLC.
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
