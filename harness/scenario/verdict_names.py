"""List the checks and their possible verdicts.

The six characteristics (Section 4.3) concern the chains of a swarm. Three further checks concern its behaviour and its
records. They have keys instead of numbers.
"""

from typing import Literal

CHARACTERISTICS = {
    "1": "distributed",
    "2": "idle ⇒ committed",
    "3": "single copy",
    "4": "genuine",
    "5": "all committed everywhere",
    "6": "one uniform chain",
}
"""Number -> short name."""

CharacteristicVerdict = Literal["holds", "violated", "not applicable"]
StepsVerdict = Literal["as specified", "deviates", "not applicable"]
RecordsVerdict = Literal["agree", "contradict", "not applicable"]
LivenessVerdict = Literal["finished", "not finished", "never finishes", "not applicable"]

Verdict = CharacteristicVerdict | StepsVerdict | RecordsVerdict | LivenessVerdict

FURTHER_CHECKS = {"steps": "every step", "records": "every record", "liveness": "liveness"}
"""Key of a further check -> short name."""

ALL_CHECKS = {**CHARACTERISTICS, **FURTHER_CHECKS}
"""All checks in the order of the report: number or key -> short name."""

BAD_IN_WORDS = {
    **{number: f"characteristic {number} violated" for number in CHARACTERISTICS},
    "steps": "steps deviate",
    "records": "records contradict",
    "liveness": "swarm not finished",
}
"""Number or key of a check -> a bad verdict in words."""

UNFINISHED: Verdict = "not finished"
"""The bad verdict of a swarm that may only need more time. It has an exit status of its own."""

Kind = Literal["good", "bad", "unknown"]

_GOOD = frozenset(("holds", "as specified", "agree", "finished"))
_BAD = frozenset(("violated", "deviates", "contradict", "not finished", "never finishes"))


def kind_of(verdict: str) -> Kind:
    """Return the class of a verdict: good, bad or unknown. A bad verdict leads to exit status 1 or 4."""
    return "good" if verdict in _GOOD else "bad" if verdict in _BAD else "unknown"
