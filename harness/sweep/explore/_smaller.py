"""Define the steps that reduce a scenario. Steps that shorten runs come first, and then steps that simplify the
scenario.

A scripted loss (a fate) identifies its message either by a time or by a count. With a time, it still matches the same
message if other messages disappear. With a count, it still matches the same message if everything happens earlier.
After each change between these two forms, all steps are tried again.

A document is reduced step by step (delta debugging), to the smallest scenario that still violates a check. The result
does not depend on the number of processes. The search considers the results of candidate scenarios in a fixed order. If
a candidate still violates the check, the search discards the results of later candidates.
"""

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import combinations, islice
from typing import Any, TypeVar

from pydantic import ValidationError

from harness.run.parallel import sweep
from harness.scenario import Scenario
from harness.scenario.scenario_file import to_yaml
from harness.sweep.explore._recording import LostMessage, RecordedEvent, Recording
from harness.sweep.explore._scenario_document import (
    Document,
    at,
    cut_after,
    event_of,
    event_times,
    fate_by_count,
    fate_by_time,
    keep_agents,
    move_times,
    script,
    timeline,
    with_drops,
    with_key,
    with_script,
)
from ucp.events import EVENT_HEADER_BYTES
from ucp.settings import Settings

T = TypeVar("T")

WORTH_FORKING_S = 0.03
"""Minimum duration of a run, in seconds, for which several processes play runs in parallel. For shorter runs, starting
the processes would take longer.
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
    """Divide `items` into `parts` parts. For each part, yield all other items. The last part comes first, because fewer
    items depend on later items.
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


MAX_ROUNDS = 8
MAX_PAIRED = 12
"""Maximum number of agents in a scenario for which the search tries to remove each pair of agents."""
DELAY_S = 0.02
SLACKS_S = (0.3, 0.03)
GAPS_S = (1, 2, 5, 10, 11, 15, 20, 30, 60)
"""Distances between two successive events in seconds, shortest first. The search tries each of them."""

Record = Callable[[Document], Recording]


def shrink(shrinker: Shrinker, record: Record) -> None:
    """Reduce the scenario until no step makes it smaller. Raises BudgetSpentError."""
    for _ in range(MAX_ROUNDS):
        before = shrinker.best
        for express in (_fates_by_time, _fates_by_count):
            express(shrinker, record)
            for step in (_shorten_mission, _remove_final_reconcile, _fewer_agents, _fewer_of_each, _use_defaults):
                step(shrinker)
            _blocks_of_one_event(shrinker, record)
        _round_times(shrinker)
        _reduce_gaps(shrinker)
        if shrinker.best == before:
            return


def replays(document: Document, recording: Recording) -> Iterator[Document]:
    """Yield candidate scenarios that may reproduce the recorded run without random numbers. The last candidate is
    `document` itself.
    """
    lost = [loss for loss in recording.lost if not loss.by_quirk]
    everything = with_script(document, recording.logged, [fate_by_count(loss) for loss in recording.lost])
    ignored = at(document, "quirks.ignore_commit")
    if ignored:
        yield with_key(everything, "quirks.ignore_commit", None)
    faithful = with_script(document, recording.logged, [fate_by_count(loss) for loss in lost])
    yield faithful
    yield with_key(faithful, "network.delay", DELAY_S)
    yield {**document, "events": {"source": "scripted", "script": [event_of(event) for event in recording.logged]}}
    yield document


def _fates_by_time(shrinker: Shrinker, record: Record) -> None:
    document, lost = shrinker.best, record(shrinker.best).lost
    if document.get("fates"):
        shrinker.first(with_drops(document, [fate_by_time(loss, slack) for loss in lost]) for slack in SLACKS_S)


def _fates_by_count(shrinker: Shrinker, record: Record) -> None:
    document, lost = shrinker.best, record(shrinker.best).lost
    if document.get("fates"):
        shrinker.first([with_drops(document, [fate_by_count(loss) for loss in lost])])


def _shorten_mission(shrinker: Shrinker) -> None:
    """End the mission as soon as possible after the last event."""
    moments = event_times(shrinker.best)
    low, high = -1, len(moments) - 1  # a violation is known up to `high`, none up to `low`
    while high - low > 1:
        middle = (low + high) // 2
        if shrinker.first([cut_after(shrinker.best, moments[middle])]) is not None:
            high = middle
        else:
            low = middle
    last = max(event_times(shrinker.best), default=0.0)
    now = shrinker.best.get("duration_s", 1200.0)
    ends = [max(1.0, last), *(last + gap for gap in GAPS_S)]
    shrinker.first({**shrinker.best, "duration_s": float(math.ceil(end))} for end in ends if math.ceil(end) < now)


def _remove_final_reconcile(shrinker: Shrinker) -> None:
    shrinker.first([with_key(shrinker.best, "final_reconcile", None)])


def _fewer_agents(shrinker: Shrinker) -> None:
    document = shrinker.best
    for delay in (at(document, "network.delay"), DELAY_S):  # fewer agents draw other latencies
        base = with_key(document, "network.delay", delay)
        shrinker.fewest(document["agents"], lambda kept, base=base: keep_agents(base, kept))  # type: ignore[misc]
        while _two_agents_fewer(shrinker, delay):
            pass
        if len(shrinker.best["agents"]) < len(document["agents"]):
            return


def _two_agents_fewer(shrinker: Shrinker, delay: Any) -> bool:
    """Try to remove two agents in one step, because the violation may need an even number of voters. Return true on
    success.
    """
    base = with_key(shrinker.best, "network.delay", delay)
    agents = set(base["agents"])
    if len(agents) > MAX_PAIRED:
        return False
    pairs = combinations(reversed(base["agents"]), 2)
    return shrinker.first(keep_agents(base, agents - {*pair}) for pair in pairs) is not None


def _fewer_of_each(shrinker: Shrinker) -> None:
    wrong = [f"quirks.{name}.agents" for name in shrinker.best.get("quirks", {})]
    for key in ("timeline", "schedule", "events.script", "fates", "datagrams", "network.links", *wrong):
        document = shrinker.best
        if at(document, key):
            shrinker.fewest(at(document, key), lambda kept, d=document, k=key: with_key(d, k, list(kept)))  # type: ignore[misc]
    for key in ("clocks", "lateness", "network.receivers"):
        document = shrinker.best
        named: dict[str, Any] = at(document, key) or {}
        shrinker.fewest(list(named.items()), lambda kept, d=document, k=key: with_key(d, k, dict(kept)))  # type: ignore[misc]


def _use_defaults(shrinker: Shrinker) -> None:
    """Replace values by their defaults. If this fails for the network, at least use the same latency for all
    messages.
    """
    for key in (
        "initial_data",
        "lateness",
        "settings",
        "stagger",
        "quirks",
        "network",
        "settle",
        "timeline",
        "schedule",
    ):
        shrinker.first([with_key(shrinker.best, key, None)])
    for part in ("settings", "quirks", "network"):
        for key in list(at(shrinker.best, part) or ()):
            shrinker.first([with_key(shrinker.best, f"{part}.{key}", None)])
    if at(shrinker.best, "network.delay") is None or isinstance(at(shrinker.best, "network.delay"), dict):
        shrinker.first([with_key(shrinker.best, "network.delay", DELAY_S)])


def _blocks_of_one_event(shrinker: Shrinker, record: Record) -> None:
    """Change the scenario so that a single event completes each block. The event occurs at the time at which the agent
    completed the block in the recorded run.
    """
    document = shrinker.best
    largest = at(document, "settings.max_event_bytes") or Settings().max_event_bytes
    if at(document, "settings.max_block_bytes") == largest or not script(document):
        return
    size = min(256, largest - EVENT_HEADER_BYTES)
    events = [
        RecordedEvent(event.at_s, event.agent, size, True) for event in record(document).logged if event.completes
    ]
    smaller = with_key(document, "events.script", [event_of(event) for event in events])
    shrinker.first([with_key(smaller, "settings.max_block_bytes", largest)])


def _round_times(shrinker: Shrinker) -> None:
    document = shrinker.best

    def rounded(digits: int) -> Document:
        return move_times(document, lambda at_s: float(round(at_s, digits)))

    shrinker.first(map(rounded, (0, 1, 2, 3)))


def _reduce_gaps(shrinker: Shrinker) -> None:
    """Reduce the time between successive events."""
    for index in range(len(event_times(shrinker.best))):
        moments = event_times(shrinker.best)
        if index >= len(moments):
            return
        moment, before = moments[index], moments[index - 1] if index else 0.0
        gap = moment - before
        gaps = [*(float(shorter) for shorter in GAPS_S if shorter < gap), float(math.ceil(gap))]
        shifts = [_time_shift(moment, before + shorter) for shorter in gaps if shorter != gap]
        shrinker.first(move_times(shrinker.best, shift) for shift in shifts)


def _time_shift(moment: float, earlier: float) -> Callable[[float], float]:
    """Return a function that changes times. It replaces the time `moment` by `earlier`, and makes all later times
    earlier by the same amount.
    """
    return lambda at_s: round(at_s - moment + earlier, 6) if at_s >= moment else at_s


def size(document: Document) -> str:
    """Return a text with the size of a scenario, such as "5 agents, 203 events, 61 fates"."""
    counts = {
        "agent": len(document["agents"]),
        "event": len(script(document)),
        "fate": len(document.get("fates", [])),
        "fault": len(timeline(document)),
        "datagram": len(document.get("datagrams", [])),
    }
    always = ("agent", "event", "fate")
    return ", ".join(
        f"{count} {word}{'' if count == 1 else 's'}" for word, count in counts.items() if count or word in always
    )


def scenario_of(document: Document) -> Scenario:
    return Scenario.model_validate(document)
