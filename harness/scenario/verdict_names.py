"""List the checks and their possible verdicts.

The six characteristics (Section 4.3) concern the chains of a swarm. Three further checks concern its behaviour and its
records. The further checks have keys instead of numbers.
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
"""Number of a characteristic -> its short name."""

CharacteristicVerdict = Literal["holds", "violated", "not applicable"]
StepsVerdict = Literal["as specified", "deviates", "not applicable"]
RecordsVerdict = Literal["agree", "contradict", "not applicable"]
LivenessVerdict = Literal["finished", "not finished", "never finishes", "not applicable"]

Verdict = CharacteristicVerdict | StepsVerdict | RecordsVerdict | LivenessVerdict

FURTHER_CHECKS = {"steps": "every step", "records": "every record", "liveness": "liveness"}
"""Key of a further check -> short name."""

ALL_CHECKS = {**CHARACTERISTICS, **FURTHER_CHECKS}
"""All checks in the order of the report: number of a characteristic or key of a further check -> short name."""

ENDED = "ended"
"""Key of the verdict on agents that crashed or hung in a run in memory. Other runs have no such verdict."""

RUN_CHECKS = {**ALL_CHECKS, ENDED: "every agent to the end"}
"""All checks of a run in memory: number of a characteristic or key -> short name."""

BAD_IN_WORDS = {
    **{number: f"characteristic {number} violated" for number in CHARACTERISTICS},
    "steps": "steps deviate",
    "records": "records contradict",
    "liveness": "swarm not finished",
    ENDED: "an agent crashed or hung",
}
"""Number or key of a check -> phrase for its bad verdict."""

UNFINISHED: Verdict = "not finished"
"""The verdict on a swarm that did not finish but may only need more time. It is a bad verdict with its own exit
status.
"""

Kind = Literal["good", "bad", "unknown"]

_GOOD = frozenset(("holds", "as specified", "agree", "finished"))
_BAD = frozenset(("violated", "deviates", "contradict", "not finished", "never finishes"))


def kind_of(verdict: str) -> Kind:
    """Return the class of a verdict: good, bad or unknown. A bad verdict leads to exit status 1 or 4."""
    return "good" if verdict in _GOOD else "bad" if verdict in _BAD else "unknown"
