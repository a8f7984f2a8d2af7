"""Decide from the recorded files of a run whether the protocol kept its six required properties.

For each characteristic, one file contains a function that takes an `Evidence` and returns a `Judgement`. `_verdict.py`
collects the judgements. `survival.py` reports the blocks that were lost together with vehicles, and the blocks that the
loss of further vehicles would destroy.
"""

from harness.checker._verdict import Result, check, stored_differences
from harness.checker.evidence import Evidence, gather

__all__ = ["Evidence", "Result", "check", "gather", "stored_differences"]
