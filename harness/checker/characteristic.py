"""A verdict on one characteristic, with its reason and evidence.

A check that could not look is `not applicable`, never `holds`.
"""

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Verdict = Literal["holds", "violated", "not applicable"]

MAX_EVIDENCE = 50
"""More pieces of evidence than anyone reads are counted in the reason and not listed."""


@dataclass(frozen=True)
class Finding:
    """One piece of evidence: which agent, which block if any, and what was seen where."""

    agent_id: int
    detail: str
    block: str | None = None
    block_hash: str | None = None


@dataclass(frozen=True)
class Characteristic:
    name: str
    verdict: Verdict
    reason: str
    evidence: list[Finding] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "verdict": self.verdict,
            "reason": self.reason,
            "evidence": [asdict(finding) for finding in self.evidence],
        }


def violated(name: str, what: str, findings: list[Finding]) -> Characteristic:
    """`what` completes the sentence "N times ...", as in "1 time an idle agent ..."."""
    times = f"{len(findings)} time{'s' if len(findings) != 1 else ''}"
    return Characteristic(name, "violated", f"{times}: {what}", findings[:MAX_EVIDENCE])


def agents(ids: "list[int] | set[int] | tuple[int, ...]") -> str:
    """ "agent 3", "agents 3 and 4", "agents 1, 2 and 5"."""
    names = [str(agent_id) for agent_id in sorted(ids)]
    if len(names) == 1:
        return f"agent {names[0]}"
    return f"agents {', '.join(names[:-1])} and {names[-1]}"
