"""Show the verdicts in the report: the characteristics and the further checks, with reasons and evidence."""

from dataclasses import dataclass
from typing import Any

from harness.archive.run_record import CharacteristicRecord, FindingRecord, JudgementRecord, RunRecord
from harness.scenario.expect import AS_EXPECTED, Expect
from harness.scenario.verdict_names import ALL_CHECKS, CHARACTERISTICS, FURTHER_CHECKS, kind_of

STATEMENTS = {
    "1": "The protocol is distributed, event driven and asynchronous.",
    "2": "An idle agent has all blocks that it completed in its chain.",
    "3": "No agent holds more than one copy of a block.",
    "4": "Every block was made by an agent of the mission.",
    "5": "When the system is fully connected, all blocks enter all chains.",
    "6": "When the system is fully connected and reconciled, all chains are equal.",
    "steps": "Every step of every agent follows the 20 algorithms.",
    "records": "Independent records of the same facts agree.",
    "liveness": "The swarm became idle after the last event.",
}
ICONS = {"good": "✓", "bad": "✗", "unknown": "\u2013"}
KINDS = {"good": "holds", "bad": "violated", "unknown": "unknown"}
"""The CSS class for each assessment of a verdict: "good", "bad" or "unknown"."""
EVIDENCE_KEPT = 200


@dataclass(frozen=True, slots=True)
class VerdictEntry:
    key: str
    number: str
    """The number of the characteristic, or an empty text if the verdict belongs to a further check."""
    name: str
    statement: str
    verdict: str
    icon: str
    kind: str
    """CSS class of the verdict."""
    reason: str
    evidence: list[dict[str, Any]]
    """The evidence for the verdict, as pairs of a label and a value."""
    evidence_left_out: int
    remark: str = ""
    """A text that compares the verdict with the expected verdict, such as "as expected". The text is empty if the
    scenario expects no verdict.
    """

    @property
    def in_words(self) -> str:
        """The verdict with a remark, such as "violated, as expected"."""
        return ", ".join(filter(None, (self.verdict, self.remark)))

    @property
    def is_bad(self) -> bool:
        return self.kind == "violated"

    @property
    def topic(self) -> str:
        """The name of the check for use in a sentence, such as "characteristic 6" or "steps"."""
        return f"characteristic {self.number}" if self.number else self.name

    @property
    def title(self) -> str:
        """The title of the check, such as "6. one uniform chain" or "steps"."""
        return f"{self.number}. {self.name}" if self.number else self.name


def verdicts(record: RunRecord) -> list[VerdictEntry]:
    """Return all verdicts of a judged run. A characteristic without a recorded verdict is "not judged".

    Return no verdicts if the run was not judged.
    """
    if not record.characteristics:
        return []
    judged = record.judgements
    keys = sorted({*record.characteristics, *CHARACTERISTICS}, key=lambda key: (len(key), key))
    keys += [key for key in FURTHER_CHECKS if key in judged]
    return [_verdict(key, judged.get(key), record.expect) for key in keys]


def _verdict(key: str, judged: CharacteristicRecord | JudgementRecord | None, expect: Expect) -> VerdictEntry:
    kind, evidence = kind_of(judged.verdict) if judged else "unknown", judged.evidence if judged else []
    return VerdictEntry(
        key=key,
        number="" if key in FURTHER_CHECKS else key,
        name=judged.name if judged else ALL_CHECKS[key],
        statement=STATEMENTS.get(key, ""),
        verdict=judged.verdict if judged else "not judged",
        icon=ICONS[kind] if judged else "?",
        kind=KINDS[kind],
        reason=judged.reason if judged else "",
        evidence=[_evidence(finding) for finding in evidence[:EVIDENCE_KEPT]],
        evidence_left_out=max(0, len(evidence) - EVIDENCE_KEPT),
        remark=expect.remark(key, judged.verdict) if judged else "",
    )


def headline(verdicts: list[VerdictEntry], *, completed: bool) -> tuple[str, str]:
    """Return a summary of the verdicts in one line, and the CSS class of the summary.

    If the run was not completed, the class is never "holds". If the scenario expected all bad verdicts, the class is
    "unknown".
    """
    characteristics = [verdict for verdict in verdicts if verdict.number]
    violated, holding = (sum(verdict.kind == kind for verdict in characteristics) for kind in ("violated", "holds"))
    beside = [f"{verdict.name}: {verdict.in_words}" for verdict in verdicts if not verdict.number and verdict.is_bad]
    bad = "unknown" if all(verdict.remark == AS_EXPECTED for verdict in verdicts if verdict.is_bad) else "violated"
    if violated:
        all_expected = all(verdict.remark == AS_EXPECTED for verdict in characteristics if verdict.is_bad)
        count = f"{violated} of {len(characteristics)} characteristics violated"
        return "; ".join([f"{count}, {AS_EXPECTED}" if all_expected else count, *beside]), bad
    if not verdicts:
        return "not judged", "unknown"
    words_for_it = "; ".join([f"none violated, {holding} of {len(characteristics)} hold", *beside])
    return words_for_it, bad if beside else "holds" if completed and holding else "unknown"


def _evidence(finding: FindingRecord) -> dict[str, object]:
    labels = {"agent_id": "agent", "block_hash": "hash"}
    return {labels.get(key, key): value for key, value in finding.model_dump(exclude_none=True).items()}
