"""Shrink a document by delta debugging, and write the smallest scenario that still fails.

What is tried, and how it ends, is the same however many processes try: candidates count in their order, and what
others found out meanwhile about later ones is forgotten.
"""

import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any, TypeVar

from pydantic import ValidationError

from harness.run.parallel import sweep
from harness.scenario import Scenario
from harness.scenario.scenario_file import to_yaml
from harness.sweep.explore._recording import Lost, Recording
from harness.sweep.explore._scenario_document import Document, at

T = TypeVar("T")

WORTH_FORKING_S = 0.03
"""Runs that are shorter take less time than to have another process play them."""


class BudgetSpentError(Exception):
    """As many runs were played as may be."""


class Shrinker:
    """`best` is the smallest document so far of which `violates` is true; `adopted` is called with each better one."""

    def __init__(
        self,
        best: Document,
        violates: Callable[[Scenario], bool],
        *,
        jobs: int,
        max_runs: int,
        adopted: Callable[["Shrinker"], None],
    ) -> None:
        self.best = best
        self.runs = 0
        self._violates = violates
        self._jobs = jobs
        self._max_runs = max_runs
        self._adopted = adopted
        self._in_vain: set[str] = set()
        self._pace_s = 1.0

    def first(self, candidates: Iterable[Document]) -> int | None:
        """Take the first candidate that violates; its index, or None. Raises BudgetSpentError."""
        if self.runs >= self._max_runs:
            raise BudgetSpentError
        jobs = self._jobs if self._pace_s > WORTH_FORKING_S else 1
        started, before = time.monotonic(), self.runs
        try:
            with sweep(self._new(candidates), lambda task: self._violates(task[1]), jobs) as outcomes:
                for (index, _, document), violates in outcomes:
                    self.runs += 1
                    if violates is True:  # a run that failed is none
                        self.best = document
                        self._adopted(self)
                        return index
                    self._in_vain.add(_key(document))
                    if self.runs >= self._max_runs:
                        raise BudgetSpentError
        finally:
            if self.runs > before:
                self._pace_s = (time.monotonic() - started) * jobs / (self.runs - before)
        return None

    def _new(self, candidates: Iterable[Document]) -> Iterator[tuple[int, Scenario, Document]]:
        """Those that are scenarios, smaller or not, and have not been tried."""
        seen = {_key(self.best)}
        for index, document in enumerate(candidates):
            key = _key(document)
            if key in seen or key in self._in_vain:
                continue
            seen.add(key)
            try:
                yield index, Scenario.model_validate(document), document
            except ValidationError:
                continue

    def fewest(self, items: Sequence[T], with_items: Callable[[Sequence[T]], Document]) -> None:
        """Zeller's ddmin: leave out ever smaller parts of `items`, until none can be left out."""
        kept = list(items)
        if not kept or self.first([with_items([])]) is not None:
            return
        parts = 2
        while len(kept) > 1:
            left = list(_leaving_out(kept, parts))
            index = self.first(map(with_items, left))
            if index is not None:
                kept, parts = left[index], max(parts - 1, 2)
            elif parts >= len(kept):
                return
            else:
                parts = min(2 * parts, len(kept))


def _leaving_out(items: Sequence[T], parts: int) -> Iterator[list[T]]:
    """All of `items` but one part, for each of `parts` parts; the last first, on which the least depends."""
    bounds = [len(items) * part // parts for part in range(parts + 1)]
    for part in reversed(range(parts)):
        yield [*islice(items, bounds[part]), *islice(items, bounds[part + 1], None)]


def _key(document: Document) -> str:
    return json.dumps(document, sort_keys=True)


def file_of(document: Document, header: list[str], recording: Recording) -> str:
    """`recording` of this very document says when each message was sent that a fate is about."""
    sent: dict[Any, Lost] = {(lost.message, lost.sender, lost.receiver, lost.count): lost for lost in recording.lost}

    def remark(entry: Document) -> str | None:
        key = entry.get("message"), entry.get("sender"), entry.get("receiver"), _hashable(entry.get("count"))
        if (lost := sent.get(key)) is None:
            return None
        return f"sent at {lost.at_s:.3f} s" + (f", block {lost.block}" if lost.block else "")

    comment = [*header]
    if at(document, "settings.max_block_bytes") is not None:
        comment.append("Blocks are full as soon as another event of the largest size might not fit: here, after one.")
    return to_yaml(document, comment, remark)


def _hashable(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
