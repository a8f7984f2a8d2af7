"""Compare a protocol variant with the original: play the same matrix with the same seeds, and write a page of
differences.

A run of the variant and a run of the original with the same seed have the same blocks, losses and faults. The page
therefore shows the mean differences of these pairs. Their confidence intervals are narrower than those of two
independent means.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from harness.play.variant import Variant
from harness.present import text as words
from harness.scenario.verdict_names import CHARACTERISTICS, kind_of
from harness.sweep.matrix._cell import Run
from harness.sweep.matrix._estimate import Estimate, estimate_mean
from harness.sweep.matrix._matrix_file import Matrix, MatrixPoint
from harness.sweep.matrix.matrix_run import Finished
from harness.sweep.matrix.matrix_table import name_of

SEEDS_SHOWN = 5
SIGNIFICANT_DIGITS = 4


@dataclass(frozen=True)
class ComparedValue:
    """A kind of value that is compared between two runs with the same seed. `of` returns None if the value of a run is
    unknown.
    """

    label: str
    of: Callable[[Run], float | None]
    unit: Literal["share", "number"] = "number"


def _figure(name: str) -> Callable[[Run], float | None]:
    return lambda run: run.figures.get(name)


def _missing_blocks(run: Run) -> float | None:
    blocks, mutual = run.figures.get("blocks"), run.figures.get("mutual_chain")
    return None if blocks is None or mutual is None else blocks - mutual


def _forked(run: Run) -> float | None:
    chains = run.figures.get("distinct_chains")
    return None if chains is None else float(chains > 1)


def _verdict(key: str, verdict: str) -> Callable[[Run], float | None]:
    return lambda run: None if key not in run.verdicts else float(run.verdicts[key] == verdict)


def _bad(*keys: str) -> Callable[[Run], float | None]:
    return lambda run: float(any(kind_of(run.verdicts[key]) == "bad" for key in keys if key in run.verdicts))


COMPARED = (
    ComparedValue("blocks that are not in every chain", _missing_blocks),
    ComparedValue("messages", _figure("messages")),
    ComparedValue("messages per block", _figure("messages_per_block")),
    ComparedValue("reconciles", _figure("reconciles")),
    ComparedValue("seconds to one chain", _figure("uniform_at_s")),
    ComparedValue("distinct chains at the end", _figure("distinct_chains")),
    ComparedValue("runs that end with a fork", _forked, "share"),
    ComparedValue("runs with a livelock", _verdict("liveness", "never finishes"), "share"),
    ComparedValue("runs that are not finished", _verdict("liveness", "not finished"), "share"),
    ComparedValue("runs that violate a characteristic", _bad(*CHARACTERISTICS), "share"),
    ComparedValue("runs with a step that deviates", _bad("steps"), "share"),
)


@dataclass(frozen=True)
class ComparisonRow:
    """One line of the page: the mean of the original protocol, the mean of the variant, and the mean difference between
    runs with the same seed.
    """

    compared: ComparedValue
    original: float | None
    variant: float | None
    difference: Estimate
    differing: list[int]
    """Seeds whose two runs differ."""

    def to_json(self) -> dict[str, object]:
        return {
            "label": self.compared.label,
            "original": self.original,
            "variant": self.variant,
            "difference": self.difference.model_dump(),
            "differing_seeds": self.differing,
        }


@dataclass(frozen=True)
class VariantComparison:
    """The lines of the comparison for each combination of values."""

    variant: Variant
    matrix: Matrix
    rows: dict[MatrixPoint, list[ComparisonRow]]

    def to_json(self) -> dict[str, object]:
        cells = [{**point._asdict(), "rows": [row.to_json() for row in rows]} for point, rows in self.rows.items()]
        return {"schema": "ucp-variant-comparison/1", "variant": self.variant.version, "cells": cells}

    def to_markdown(self) -> str:
        return "\n".join(self._lines()) + "\n"

    def _lines(self) -> Iterator[str]:
        yield f"# {self.variant.in_words} beside the original"
        yield ""
        if self.variant.sentence:
            yield f"{self.variant.sentence}"
            yield ""
        yield (
            f"Matrix {self.matrix.name}, variant {self.variant.version}. Each seed was played with the original and "
            "with the variant. A difference is variant minus original, as the mean over all pairs with its 95 % "
            "interval."
        )
        for point, rows in self.rows.items():
            yield ""
            yield f"## {name_of(self.matrix, point)}"
            yield ""
            yield "| figure | pairs | original | variant | difference | 95 % interval | seeds that differ |"
            yield "|---|--:|--:|--:|--:|--:|---|"
            yield from map(_line, rows)


def compare_runs(variant: Variant, matrix: Matrix, original: Finished, changed: Finished) -> VariantComparison:
    """Compare all pairs of runs that have ended, and return the results."""
    before = {run.task: run for run in original.runs if run.judged}
    pairs: dict[MatrixPoint, list[tuple[Run, Run]]] = {}
    for run in changed.runs:
        if run.judged and run.task in before:
            pairs.setdefault(run.point, []).append((before[run.task], run))
    rows = {point: [_row(compared, its_pairs) for compared in COMPARED] for point, its_pairs in pairs.items()}
    return VariantComparison(variant, matrix, rows)


def _row(compared: ComparedValue, pairs: Sequence[tuple[Run, Run]]) -> ComparisonRow:
    known = [
        (run.seed, before, after)
        for original, run in pairs
        if (before := compared.of(original)) is not None and (after := compared.of(run)) is not None
    ]
    if not known:
        return ComparisonRow(compared, None, None, Estimate(n=0), [])
    return ComparisonRow(
        compared,
        sum(before for _, before, _ in known) / len(known),
        sum(after for *_, after in known) / len(known),
        estimate_mean([after - before for _, before, after in known]),
        [seed for seed, before, after in known if before != after],
    )


def _line(row: ComparisonRow) -> str:
    difference = row.difference

    def said(value: float | None, *, signed: bool = False) -> str:
        if value is None:
            return "-"
        sign = "+" if signed and value > 0 else ""
        return sign + (words.percent(value) if row.compared.unit == "share" else f"{value:.{SIGNIFICANT_DIGITS}g}")

    interval = "-" if difference.low is None else f"{said(difference.low)} … {said(difference.high)}"
    seeds = ", ".join(map(str, row.differing[:SEEDS_SHOWN]))
    more = f" and {len(row.differing) - SEEDS_SHOWN} more" if len(row.differing) > SEEDS_SHOWN else ""
    return (
        f"| {row.compared.label} | {difference.n} | {said(row.original)} | {said(row.variant)} "
        f"| {said(difference.mean, signed=True)} | {interval} | {seeds}{more} |"
    )
