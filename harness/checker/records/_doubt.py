"""Change the verdict on a characteristic if records contradict each other or are incomplete."""

from harness.checker.judgement import MAX_EVIDENCE, Judgement, agents, times
from harness.checker.records import RecordComparisons, describe_incomplete

NEEDS_TRACES = frozenset("123")
"""Characteristics that must hold at every step. Without complete traces, they are not known to hold."""
NEEDS_CONNECTIVITY = frozenset("56")
"""Characteristics that require full connectivity. An agent that could not send its messages was not connected."""


def in_doubt(number: str, judgement: Judgement, examination: RecordComparisons) -> Judgement:
    """Return the judgement on the characteristic with this number. Contradictory or incomplete records change its
    verdict.
    """
    touching = examination.touching(number)
    if touching:
        contradict = f"{times(len(touching))}: the records behind this verdict contradict each other"
        violated = judgement.verdict == "violated"
        reason = f"{judgement.reason}; {contradict}" if violated else contradict
        evidence = [*(judgement.evidence if violated else ()), *touching]
        return Judgement(judgement.name, "violated", reason, evidence[:MAX_EVIDENCE])
    if judgement.verdict == "holds" and number in NEEDS_TRACES and examination.short:
        return Judgement(judgement.name, "not applicable", describe_incomplete(examination))
    if judgement.verdict == "violated" and number in NEEDS_CONNECTIVITY and examination.unsent:
        unsent = sum(examination.unsent.values())
        reason = f"{agents([*examination.unsent])} could not send {unsent} messages, so not all agents were connected"
        return Judgement(judgement.name, "not applicable", reason)
    return judgement
