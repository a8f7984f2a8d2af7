"""Where two runs part: the first thing that an agent does in one of them and not in the other.

Runs are compared agent by agent, handler run by handler run: the life in which it is, handler, branch, trigger with the
sender's number of the message, the messages sent and the changes of chain, deque and stack. Blocks go by their names,
such as 4.11, for hashes cover timestamps. Not compared are times, which no two runs of processes share, and the state
after each run, which follows from its changes. The chains that the runs left are compared block by block.

In virtual time the same seed and scenario give the same run to the last byte. Processes part early, and rightly so:
which of two messages arrives first is for the kernel to say. Where they part first is still where to begin to look.

`steps` reads a trace line by line, `runs` compares, `keys` says what was asked for differently.
"""

from harness.report.difference._run_difference import (
    AgentDifference,
    ChainParting,
    Difference,
    KeyDifference,
    Parting,
    Step,
    compare,
)

__all__ = ["AgentDifference", "ChainParting", "Difference", "KeyDifference", "Parting", "Step", "compare"]
