"""Reduce a document step by step (delta debugging), and write the smallest scenario that still violates a check.

The result does not depend on the number of processes. The search considers the results of candidate scenarios in a
fixed order. If a candidate still violates the check, the search discards the results of later candidates.
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
from harness.sweep.explore._recording import LostMessage, Recording
from harness.sweep.explore._scenario_document import Document, at

T = TypeVar("T")

WORTH_FORKING_S = 0.03
"""Minimum duration, in seconds, of runs that are run in parallel. If runs take less time, starting processes would take
longer than the runs.
"""


class BudgetSpentError(Exception):
    """An error: the search has reached its maximum number of runs."""


class Shrinker:
    """A search for smaller documents that still violate a check. `best` is the smallest document so far for which
    `violates` returned true. `adopted` is called with each new smallest document.
    """

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
        self._rejected: set[str] = set()
        self._pace_s = 1.0

    def first(self, candidates: Iterable[Document]) -> int | None:
        """Run candidate scenarios, and adopt the first one that still violates the check. Return the index of this
        candidate. Return None if no candidate violates the check. Raises BudgetSpentError.
        """
        if self.runs >= self._max_runs:
            raise BudgetSpentError
        jobs = self._jobs if self._pace_s > WORTH_FORKING_S else 1
        started, before = time.monotonic(), self.runs
        try:
            with sweep(self._new(candidates), lambda task: self._violates(task[1]), jobs) as outcomes:
                for (index, _, document), violates in outcomes:
                    self.runs += 1
                    if violates is True:  # a failed run shows no violation
                        self.best = document
                        self._adopted(self)
                        return index
                    self._rejected.add(_key(document))
                    if self.runs >= self._max_runs:
                        raise BudgetSpentError
        finally:
            if self.runs > before:
                self._pace_s = (time.monotonic() - started) * jobs / (self.runs - before)
        return None

    def _new(self, candidates: Iterable[Document]) -> Iterator[tuple[int, Scenario, Document]]:
        """Yield the candidate scenarios that are valid and were not tried before."""
        seen = {_key(self.best)}
        for index, document in enumerate(candidates):
            key = _key(document)
            if key in seen or key in self._rejected:
                continue
            seen.add(key)
            try:
                yield index, Scenario.model_validate(document), document
            except ValidationError:
                continue

    def fewest(self, items: Sequence[T], with_items: Callable[[Sequence[T]], Document]) -> None:
        """Remove parts of `items`, first large and then smaller ones, as long as the violation still occurs (ddmin,
        Zeller 2002). In the end, the violation needs each of the remaining items.
        """
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
    """Divide `items` into `parts` parts. For each part, yield all items outside this part. The last part comes first,
    because fewer items depend on later items.
    """
    bounds = [len(items) * part // parts for part in range(parts + 1)]
    for part in reversed(range(parts)):
        yield [*islice(items, bounds[part]), *islice(items, bounds[part + 1], None)]


def _key(document: Document) -> str:
    return json.dumps(document, sort_keys=True)


def file_of(document: Document, header: list[str], recording: Recording) -> str:
    """Return the text of a scenario file. `recording` is the recorded run of this scenario. Comments in the file
    contain the times at which the run sent messages.
    """
    sent: dict[Any, LostMessage] = {
        (lost.message, lost.sender, lost.receiver, lost.count): lost for lost in recording.lost
    }

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
