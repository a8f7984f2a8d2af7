"""The whole verdict: six characteristics and the figures."""

from dataclasses import dataclass, field
from typing import Any

from harness.checker import all_committed, distributed, genuine, idle_committed, single_copy, uniform_chain
from harness.checker.characteristic import Characteristic
from harness.checker.evidence import Evidence
from harness.checker.figures import figures

CHECKS = {
    "1": distributed.check,
    "2": idle_committed.check,
    "3": single_copy.check,
    "4": genuine.check,
    "5": all_committed.check,
    "6": uniform_chain.check,
}


@dataclass(frozen=True)
class Result:
    characteristics: dict[str, Characteristic]
    figures: dict[str, float | int | None]
    errors: list[str] = field(default_factory=list)
    """A sentence for each file that could not be used, or not wholly."""

    @property
    def violated(self) -> bool:
        return any(characteristic.verdict == "violated" for characteristic in self.characteristics.values())

    def to_json(self) -> dict[str, Any]:
        """The `characteristics` and `figures` of `ucp-run/1`, and `errors`."""
        return {
            "characteristics": {
                number: characteristic.to_json() for number, characteristic in self.characteristics.items()
            },
            "figures": self.figures,
            "errors": self.errors,
        }


def check(evidence: Evidence) -> Result:
    """Decide all six characteristics from the evidence."""
    return Result(
        {number: check_one(evidence) for number, check_one in CHECKS.items()}, figures(evidence), evidence.errors
    )
