"""The verdict of one check, with its reason and its evidence.

A check without evidence is `not applicable`, never `holds`.
"""

from dataclasses import asdict, dataclass, field

from harness.scenario.verdict_names import Kind, Verdict, kind_of

MAX_EVIDENCE = 50
"""Maximum number of findings that a judgement lists. The reason of the judgement contains the total number of
findings.
"""


@dataclass(frozen=True)
class Finding:
    """One piece of evidence for a verdict."""

    agent_id: int
    """The agent that the evidence concerns."""
    detail: str
    """A phrase that describes the observation."""
    block: str | None = None
    """Short name of the block that the evidence concerns, such as 4.11. None if it concerns no block."""
    block_hash: str | None = None
    handler: str | None = None
    """Name of the handler that the evidence concerns. None if it concerns none of the 20 handlers."""


@dataclass(frozen=True)
class Judgement:
    """The verdict of one check, with its reason in one sentence and at most 50 pieces of evidence."""

    name: str
    verdict: Verdict
    reason: str
    evidence: list[Finding] = field(default_factory=list)

    @property
    def kind(self) -> Kind:
        """The class of the verdict: `good`, `bad` or `unknown`. A bad verdict leads to a nonzero exit status."""
        return kind_of(self.verdict)

    def to_json(self) -> dict[str, object]:
        """Return the judgement as an object of type `JudgementRecord` in the JSON schema `ucp-run/1`."""
        return {
            "name": self.name,
            "verdict": self.verdict,
            "reason": self.reason,
            "evidence": [asdict(finding) for finding in self.evidence],
        }


def violated(name: str, what: str, findings: list[Finding]) -> Judgement:
    """Return a judgement with the verdict `violated`. Its reason consists of the number of findings and `what`, as in
    "1 time: an idle agent ...".
    """
    return Judgement(name, "violated", f"{times(len(findings))}: {what}", findings[:MAX_EVIDENCE])


def times(count: int) -> str:
    """Return the count as a phrase, such as "1 time" or "3 times"."""
    return f"{count} time{'s' if count != 1 else ''}"


def agents(ids: "list[int] | set[int] | tuple[int, ...]") -> str:
    """Return a phrase that lists the agents, such as "agent 3", "agents 3 and 4" or "agents 1, 2 and 5"."""
    names = [str(agent_id) for agent_id in sorted(ids)]
    if len(names) == 1:
        return f"agent {names[0]}"
    return f"agents {', '.join(names[:-1])} and {names[-1]}"
