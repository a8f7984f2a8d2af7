"""The six characteristics as the page says them: verdict, reason and evidence."""

from dataclasses import dataclass
from typing import Any

from harness.archive.result import listing, mapping
from harness.present import words

SHORT_NAMES = {
    "1": "distributed",
    "2": "idle ⇒ committed",
    "3": "single copy",
    "4": "genuine",
    "5": "all committed everywhere",
    "6": "one uniform chain",
}
STATEMENTS = {
    "1": "The protocol is distributed, event driven and asynchronous.",
    "2": "An idle agent has all blocks that it completed in its chain.",
    "3": "No agent holds more than one copy of a block.",
    "4": "Every block was made by an agent of the mission.",
    "5": "Fully connected, all blocks come into all chains.",
    "6": "Fully connected and reconciled, one uniform chain emerges.",
}
ICONS = {"holds": "✓", "violated": "✗", "not applicable": "\u2013"}
EVIDENCE_KEPT = 200


@dataclass(frozen=True, slots=True)
class Verdict:
    number: str
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


def verdicts(result: dict[str, Any]) -> list[Verdict]:
    judged = mapping(result, "characteristics")
    numbers = sorted({*judged, *SHORT_NAMES} if judged else [], key=lambda key: (len(key), key))
    verdicts = []
    for key in numbers:
        entry = mapping(judged, key)
        verdict = words.value(entry.get("verdict") or "not judged")
        evidence = listing(entry, "evidence")
        verdicts.append(
            Verdict(
                number=key,
                name=words.value(entry.get("name") or SHORT_NAMES.get(key, "")),
                statement=STATEMENTS.get(key, ""),
                verdict=verdict,
                icon=ICONS.get(verdict, "?"),
                kind={"holds": "holds", "violated": "violated"}.get(verdict, "unknown"),
                reason=words.value(entry.get("reason") or ""),
                evidence=[_evidence(piece) for piece in evidence[:EVIDENCE_KEPT]],
                evidence_left_out=max(0, len(evidence) - EVIDENCE_KEPT),
            )
        )
    return verdicts


def headline(verdicts: list[Verdict], *, completed: bool) -> tuple[str, str]:
    """How it went, in a few words, and the kind of verdict that it amounts to: half a run is no success."""
    violated, holding = (sum(verdict.kind == kind for verdict in verdicts) for kind in ("violated", "holds"))
    if violated:
        return f"{violated} of {len(verdicts)} characteristics violated", "violated"
    if not verdicts:
        return "not judged", "unknown"
    return f"none violated, {holding} of {len(verdicts)} hold", "holds" if completed and holding else "unknown"


def _evidence(piece: Any) -> dict[str, Any]:
    if not isinstance(piece, dict):
        return {"detail": piece}
    labels = {"agent_id": "agent", "block_hash": "hash"}
    return {labels.get(key, words.label(key)): value for key, value in piece.items() if value is not None}
