"""Read the list of mistakes to plant in the specification from `edits.yaml`."""

import functools
import re
from pathlib import Path
from typing import NamedTuple

import yaml

from harness.proof.specification import _tlc

EDITS_FILE = Path(__file__).with_name("edits.yaml")


class Reason(NamedTuple):
    """The reason why an edit changes no behaviour.

    `because` states the reason. `always` is an invariant of an agent `a` in TLA+ that implies the reason.
    """

    because: str
    always: str


class Edit(NamedTuple):
    """A mistake in the specification. `new` replaces `old` in the part for this Algorithm (0 for the common part).

    If the edit changes no behaviour, `reason` explains why.
    """

    algorithm: int
    about: str
    old: str
    new: str
    reason: Reason | None = None

    @property
    def name(self) -> str:
        return f"{self.algorithm}: {self.about}"

    def applied(self, text: str) -> str:
        """Return `text` with the mistake. Raises ValueError unless `old` occurs exactly once in `text`."""
        pattern = r"\s+".join(map(re.escape, self.old.split()))
        edited, count = re.subn(pattern, lambda match: self.new, text)
        if count != 1:
            raise ValueError(
                f"{EDITS_FILE.name}: {self.name}: UCP.tla has this text {count} times: write the edit anew"
            )
        return edited


def specification() -> str:
    """Return the text of the TLA+ specification of an agent."""
    return (_tlc.MODULES / "UCP.tla").read_text("utf-8")


@functools.cache
def edits() -> tuple[Edit, ...]:
    """Return all mistakes in the order of the Algorithms."""
    by_algorithm = yaml.safe_load(EDITS_FILE.read_text("utf-8"))
    return tuple(
        Edit(algorithm, about, old, new, *(Reason(**reason) for reason in reasons))
        for algorithm, listed in by_algorithm.items()
        for about, old, new, *reasons in listed
    )
