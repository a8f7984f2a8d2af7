"""What two records tell of the same thing and does not agree."""

from dataclasses import dataclass

from harness.checker.judgement import Finding


@dataclass(frozen=True, slots=True)
class Contradiction:
    """`touches` is the number of the characteristic that is in doubt by it; None if none is.

    `short`: the agent's trace is not whole by it, so whoever looks at the trace has not seen all.
    """

    finding: Finding
    touches: str | None = None
    short: bool = False


def of_agent(agent_id: int, detail: str, touches: str | None = None, *, short: bool = False) -> Contradiction:
    """One that is about no block."""
    return Contradiction(Finding(agent_id, detail), touches, short)
