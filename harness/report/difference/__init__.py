"""Compare two runs. Find the first handler run of an agent that occurs in only one of them.

Runs are compared agent by agent and handler run by handler run. The comparison covers incarnation, handler, branch,
trigger with the message number, sent messages, and changes of chain, deque and stack. Blocks are compared by name, such
as 4.11, because hashes depend on timestamps. Times differ in any two runs of processes, so they are not compared. The
state after a handler run follows from its changes, so it is not compared either. The exported chains are compared block
by block.

In virtual time, the same seed and scenario give identical traces. Runs of processes differ early without an error,
because the kernel decides which of two messages arrives first. The first difference is still the place to start a
search.
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
