"""The six characteristics, and what is judged beside them, as the page says them: verdict, reason and evidence."""

from dataclasses import dataclass
from typing import Any

from harness.archive.result import listing, mapping
from harness.present import words
from harness.scenario.verdicts import BESIDE, CHARACTERISTICS, JUDGED, kind_of

STATEMENTS = {
    "1": "The protocol is distributed, event driven and asynchronous.",
    "2": "An idle agent has all blocks that it completed in its chain.",
    "3": "No agent holds more than one copy of a block.",
    "4": "Every block was made by an agent of the mission.",
    "5": "Fully connected, all blocks come into all chains.",
    "6": "Fully connected and reconciled, one uniform chain emerges.",
    "steps": "Every agent did at every step what the 20 algorithms say.",
    "records": "What two records tell about the same thing agrees.",
    "liveness": "The swarm became idle once no more events came.",
}
ICONS = {"good": "✓", "bad": "✗", "unknown": "\u2013"}
KINDS = {"good": "holds", "bad": "violated", "unknown": "unknown"}
"""For the style sheet."""
EVIDENCE_KEPT = 200


@dataclass(frozen=True, slots=True)
class Verdict:
    key: str
    number: str
    """Empty for what is judged beside the characteristics."""
    name: str
    statement: str
    verdict: str
    icon: str
    kind: str
    """One word, for the style sheet."""
    reason: str
    evidence: list[dict[str, Any]]
    """What is said of each piece of evidence, by label."""
    evidence_left_out: int

    @property
    def is_bad(self) -> bool:
        return self.kind == "violated"

    @property
    def topic(self) -> str:
        """ "characteristic 6", "steps"."""
        return f"characteristic {self.number}" if self.number else self.name

    @property
    def title(self) -> str:
        """ "6. one uniform chain", "steps"."""
        return f"{self.number}. {self.name}" if self.number else self.name


def verdicts(result: dict[str, Any]) -> list[Verdict]:
    judged = mapping(result, "characteristics")
    numbers = sorted({*judged, *CHARACTERISTICS} if judged else [], key=lambda key: (len(key), key))
    entries = {key: mapping(judged, key) for key in numbers}
    entries |= {key: mapping(result, key) for key in BESIDE if judged and mapping(result, key)}
    verdicts = []
    for key, entry in entries.items():
        verdict = words.value(entry.get("verdict") or "not judged")
        evidence = listing(entry, "evidence")
        verdicts.append(
            Verdict(
                key=key,
                number="" if key in BESIDE else key,
                name=words.value(entry.get("name") or JUDGED.get(key, "")),
                statement=STATEMENTS.get(key, ""),
                verdict=verdict,
                icon="?" if verdict == "not judged" else ICONS[kind_of(verdict)],
                kind=KINDS[kind_of(verdict)],
                reason=words.value(entry.get("reason") or ""),
                evidence=[_evidence(piece) for piece in evidence[:EVIDENCE_KEPT]],
                evidence_left_out=max(0, len(evidence) - EVIDENCE_KEPT),
            )
        )
    return verdicts


def headline(verdicts: list[Verdict], *, completed: bool) -> tuple[str, str]:
    """How it went, in a few words, and the kind of verdict that it amounts to: half a run is no success."""
    characteristics = [verdict for verdict in verdicts if verdict.number]
    violated, holding = (sum(verdict.kind == kind for verdict in characteristics) for kind in ("violated", "holds"))
    beside = [f"{verdict.name}: {verdict.verdict}" for verdict in verdicts if not verdict.number and verdict.is_bad]
    if violated:
        return "; ".join([f"{violated} of {len(characteristics)} characteristics violated", *beside]), "violated"
    if not verdicts:
        return "not judged", "unknown"
    words_for_it = "; ".join([f"none violated, {holding} of {len(characteristics)} hold", *beside])
    return words_for_it, "violated" if beside else "holds" if completed and holding else "unknown"


def _evidence(piece: Any) -> dict[str, Any]:
    if not isinstance(piece, dict):
        return {"detail": piece}
    labels = {"agent_id": "agent", "block_hash": "hash"}
    return {labels.get(key, words.label(key)): value for key, value in piece.items() if value is not None}
