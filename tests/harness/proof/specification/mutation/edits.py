"""Mistakes as data: `edits.yaml`."""

import re
from pathlib import Path
from typing import NamedTuple

import yaml

from harness.proof.specification import _tlc

EDITS_FILE = Path(__file__).with_name("edits.yaml")


class Edit(NamedTuple):
    """A mistake in the specification: `new` in place of `old`, in the operator of this Algorithm (0: shared text)."""

    algorithm: int
    about: str
    old: str
    new: str

    @property
    def name(self) -> str:
        return f"{self.algorithm}: {self.about}"

    def applied(self, text: str) -> str:
        """Return `text` with the mistake. Raises ValueError unless `old` occurs exactly once."""
        pattern = r"\s+".join(map(re.escape, self.old.split()))
        edited, count = re.subn(pattern, lambda match: self.new, text)
        if count != 1:
            raise ValueError(
                f"{EDITS_FILE.name}: {self.name}: UCP.tla has this text {count} times: write the edit anew"
            )
        return edited


def specification() -> str:
    """Return the text of the specification of one agent."""
    return (_tlc.MODULES / "UCP.tla").read_text("utf-8")


def edits() -> list[Edit]:
    """Return all mistakes, in the order of the Algorithms."""
    by_algorithm = yaml.safe_load(EDITS_FILE.read_text("utf-8"))
    return [Edit(algorithm, *words) for algorithm, listed in by_algorithm.items() for words in listed]
