"""Compare two runs. Find the first handler run of an agent that occurs in only one of them.

Runs are compared agent by agent and handler run by handler run. The comparison covers incarnation, handler, branch,
trigger with the message number, sent messages, and changes of chain, deque and stack. Blocks are compared by name, such
as 4.11, because hashes depend on timestamps. Times are not compared, because they differ between any two runs of
processes. The state after a handler run follows from its changes, so it is not compared either. The exported chains are
compared block by block.

In virtual time, the same seed and scenario give identical traces. Runs of processes soon differ even without an error,
because the kernel decides which of two messages arrives first. The first difference is still a good place to start an
analysis.
"""

from harness.report.difference._run_difference import (
    AgentDifference,
    ChainDifference,
    ComparedStep,
    FirstDifference,
    KeyDifference,
    RunDifference,
    compare,
)

__all__ = [
    "AgentDifference",
    "ChainDifference",
    "ComparedStep",
    "FirstDifference",
    "KeyDifference",
    "RunDifference",
    "compare",
]
