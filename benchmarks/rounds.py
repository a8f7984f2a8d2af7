"""Combine the figures of all rounds of a benchmark, and print them as a table or as JSON."""

from __future__ import annotations

import json
import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Spread:
    """Median, minimum and maximum of a figure over all rounds."""

    median: float
    least: float
    most: float

    @classmethod
    def of(cls, figures: Iterable[float]) -> Spread:
        found = sorted(figures)
        return cls(statistics.median(found), found[0], found[-1])

    @classmethod
    def of_ratios(cls, figures: Sequence[float], others: Sequence[float]) -> Spread:
        """Return the spread of the ratios of two figures. Each ratio is of the same round, so a slow machine affects
        both figures.
        """
        return cls.of(figure / other for figure, other in zip(figures, others, strict=True))

    def __format__(self, form: str) -> str:
        """Format the median, minimum and maximum with `form`, such as "0.42 (0.40..0.47)"."""
        return f"{self.median:{form}} ({self.least:{form}}..{self.most:{form}})"


def show(rows: Sequence[Mapping[str, Any]], forms: Mapping[str, str], as_json: bool) -> None:
    """Print the rows of a table. All rows have the same keys, and `forms` contains the format for each key."""
    if as_json:
        json.dump([{k: asdict(v) if isinstance(v, Spread) else v for k, v in row.items()} for row in rows], sys.stdout)
        sys.stdout.write("\n")
        return
    lines = [list(rows[0]), *([f"{value:{forms.get(key, '')}}" for key, value in row.items()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        sys.stdout.write("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) + "\n")
