"""A characteristic in the light of what the records contradict: doubted where they do, unknown where one is short."""

from harness.checker.judgement import MAX_EVIDENCE, Judgement, times
from harness.checker.records import Examination, not_whole

LOOK_AT_TRACES = frozenset("123")
"""What is said to hold at every step holds of steps that nobody has seen only if there are none."""


def in_doubt(number: str, judgement: Judgement, examination: Examination) -> Judgement:
    """The judgement on the characteristic with this number, as it can stand."""
    touching = examination.touching(number)
    if touching:
        contradict = f"{times(len(touching))}: the records behind this verdict contradict each other"
        violated = judgement.verdict == "violated"
        reason = f"{judgement.reason}; {contradict}" if violated else contradict
        evidence = [*(judgement.evidence if violated else ()), *touching]
        return Judgement(judgement.name, "violated", reason, evidence[:MAX_EVIDENCE])
    if judgement.verdict == "holds" and number in LOOK_AT_TRACES and examination.short:
        return Judgement(judgement.name, "not applicable", not_whole(examination))
    return judgement
