"""The checker: decides from exports, and more from traces, whether the six characteristics hold (Section 4.3).

One file per characteristic, each a function from `Evidence` to `Judgement`; `_verdict.py` gathers them. Beside
them, `survival.py` says what the loss of vehicles took and could take.
"""

from harness.checker._verdict import Result, check
from harness.checker.evidence import Evidence, gather

__all__ = ["Evidence", "Result", "check", "gather"]
