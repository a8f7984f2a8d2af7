"""The verdicts that there are: on the six characteristics (Section 4.3), and on how a swarm came to what it holds.

Beside the characteristics, which judge what came out, stand judgements with keys of their own.
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

BESIDE = {"steps": "every step", "records": "every record", "liveness": "liveness"}
"""Key of a judgement beside the characteristics -> short name."""

JUDGED = {**CHARACTERISTICS, **BESIDE}
"""All that a run is judged by, in the order in which it is shown."""

BAD_IN_WORDS = {
    **{number: f"characteristic {number} violated" for number in CHARACTERISTICS},
    "steps": "steps deviate",
    "records": "records contradict",
    "liveness": "swarm not finished",
}
"""What a bad verdict says of a run, in a few words."""

Kind = Literal["good", "bad", "unknown"]

_GOOD = frozenset(("holds", "as specified", "agree", "finished"))
_BAD = frozenset(("violated", "deviates", "contradict", "not finished", "never finishes"))


def kind_of(verdict: str) -> Kind:
    """What a verdict amounts to; a bad one makes the exit status 1."""
    return "good" if verdict in _GOOD else "bad" if verdict in _BAD else "unknown"
