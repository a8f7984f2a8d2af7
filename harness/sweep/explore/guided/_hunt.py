"""The hunt: change documents, play them, and keep those that reach something new.

It goes by rounds. What a round tries depends on what was kept before it and on the lots alone, never on how fast
anything was, so that it is the same however many processes play.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from random import Random
from typing import NamedTuple

from pydantic import ValidationError

from harness.errors import ScenarioError, UnsupportedError
from harness.proof.coverage import Reached
from harness.proof.coverage.reached import MOST
from harness.run.parallel import Failed, sweep
from harness.scenario import Scenario
from harness.sweep.explore._scenario_document import Document, with_key
from harness.sweep.explore.guided._finding_identity import Identity
from harness.sweep.explore.guided._hunt_trial import Apart, Tried, Ways, tried, with_liveness_phase
from harness.sweep.explore.guided._mutation import Limits, changed

BITS = 1 << 28
"""32 MiB. Of ten million numbers one in thirty is taken for another that was there before."""


class Beyond:
    """Numbers of local states, or of pairs, which are digests. `count` is how many there are, at least."""

    def __init__(self) -> None:
        self.count = 0
        self._bits = bytearray(BITS // 8)

    def __contains__(self, number: int) -> bool:
        place = number % BITS
        return bool(self._bits[place >> 3] >> (place & 7) & 1)

    def add(self, number: int) -> None:
        """Take down one that is not there."""
        place = number % BITS
        self._bits[place >> 3] |= 1 << (place & 7)
        self.count += 1


ROUND = 64
"""Runs that are tried before it is looked at what they reached."""
MOST_KEPT = 3000
"""Documents that are kept; those that gave least for their length go first."""
MOST_FAILED = 100
MOST_WAYS = 100_000
"""When so many ways are known on which votes failed, others are not told from them: 50 MB."""
WORTH_OF_WAYS = 100
"""Local states for which new ways count on which votes failed."""
NEWEST = 24
NEAR = 0.6
SEEDS = 1 << 16


class Candidate(NamedTuple):
    """A document to be played with a seed; without its liveness phase, which every run has."""

    document: Document
    seed: int

    def scenario(self) -> Scenario:
        """What is played. Raises ValidationError if that cannot be."""
        return Scenario.model_validate(with_liveness_phase(self.document))


@dataclass
class Kept:
    """A candidate that gave something new: `gave` local states, or what counts as such, for `steps` handler runs."""

    candidate: Candidate
    gave: int
    steps: int
    failed: int
    """Votes that failed one after the other, on ways on which nobody had gone before."""
    timers_ended_s: tuple[float, ...]
    picked: int = 0

    @property
    def worth(self) -> float:
        """How promising it is to change it."""
        return (1 + self.gave) / (1 + self.picked) / (100 + self.steps)

    @property
    def nearness(self) -> float:
        """How promising it is to look for a livelock near it; 0 if votes did not fail in vain."""
        return self.failed**2 / (1 + self.picked) / (100 + self.steps)


@dataclass(frozen=True)
class News:
    """What a run reached that nobody had before its round, and which findings it showed."""

    reached: Reached
    found: tuple[Identity, ...]
    apart: Apart | None
    timers_ended_s: tuple[float, ...]
    in_vain: Ways

    @classmethod
    def of(cls, run: Tried, known: Reached) -> "News":
        new = Reached(
            run.reached.states - known.states,
            run.reached.pairs - known.pairs,
            run.reached.branches,
            run.reached.steps,
            run.reached.untold,
        )
        return cls(new, run.found, run.apart, run.timers_ended_s, run.in_vain)


@dataclass
class Hunt:
    """What is known by now, and what is kept."""

    limits: Limits
    lots: Random
    reached: Reached = field(default_factory=Reached)
    states_beyond: Beyond = field(default_factory=Beyond)
    pairs_beyond: Beyond = field(default_factory=Beyond)
    """What was reached when `reached` was full."""
    kept: list[Kept] = field(default_factory=list)
    runs: int = 0
    found: dict[Identity, Candidate] = field(default_factory=dict)
    """Findings, and the first run that showed each."""
    shown: Counter[Identity] = field(default_factory=Counter)
    """In how many runs."""
    failures: int = 0
    failed: list[tuple[Candidate, str]] = field(default_factory=list)
    """The first runs without a verdict, and why; `failures` counts all of them."""
    _dropped: list[Candidate] = field(default_factory=list)
    _apart: set[Apart] = field(default_factory=set)
    """How chains differed at rest: of each way the first is played again, with a final reconcile."""
    _in_vain: set[Ways] = field(default_factory=set)
    """How agents went on while votes failed: of each way the first run is kept."""
    _to_reconcile: list[Candidate] = field(default_factory=list)

    def begin(self, candidates: Iterable[Candidate], jobs: int) -> Iterator[tuple[Candidate, bool]]:
        """Play these as they are; each run that was played, and whether it is kept."""
        yield from self._play(list(candidates), jobs)

    def round(self, jobs: int) -> Iterator[tuple[Candidate, bool]]:
        """Change what is kept, and play it; each run that was played, and whether it is kept."""
        to_reconcile, self._to_reconcile = self._to_reconcile, []
        worth = list(accumulate(kept.worth for kept in self.kept))
        yield from self._play([*to_reconcile, *(self._next(worth) for _ in range(ROUND))], jobs)

    def dropped(self) -> list[Candidate]:
        """What is no longer kept, since it was last asked for."""
        dropped, self._dropped = self._dropped, []
        return dropped

    def _play(self, candidates: Sequence[Candidate], jobs: int) -> Iterator[tuple[Candidate, bool]]:
        known = self.reached

        def play(candidate: Candidate) -> News | None:
            try:
                return News.of(tried(candidate.scenario(), candidate.seed), known)
            except (ValidationError, ScenarioError, UnsupportedError):  # a change has asked for what cannot be played
                return None

        with sweep(candidates, play, jobs) as outcomes:
            for candidate, outcome in outcomes:
                if outcome is None:
                    continue
                self.runs += 1
                if isinstance(outcome, Failed):
                    self.failures += 1
                    if len(self.failed) < MOST_FAILED:
                        self.failed.append((candidate, outcome.reason))
                    yield candidate, False
                else:
                    yield candidate, self._learn(candidate, outcome)

    def _learn(self, candidate: Candidate, news: News) -> bool:
        """Whether it reached anything that nobody had before it."""
        for identity in news.found:
            self.shown[identity] += 1
            self.found.setdefault(identity, candidate)
        if news.apart is not None and news.apart not in self._apart:
            self._apart.add(news.apart)
            document = with_key(candidate.document, "final_reconcile", True)
            self._to_reconcile.append(candidate._replace(document=document))
        gave = _taken_down(news.reached.states, self.reached.states, self.states_beyond)
        pairs = _taken_down(news.reached.pairs, self.reached.pairs, self.pairs_beyond)
        branches = any(branch not in self.reached.branches for branch in news.reached.branches)
        self.reached.add(news.reached)
        failed = 0
        if news.in_vain and news.in_vain not in self._in_vain and len(self._in_vain) < MOST_WAYS:
            self._in_vain.add(news.in_vain)
            failed = sum(way.count("voting") for way in news.in_vain)
            gave += WORTH_OF_WAYS
        if not (gave or branches or pairs):
            return False
        self.kept.append(Kept(candidate, gave, news.reached.steps, failed, news.timers_ended_s))
        if len(self.kept) > MOST_KEPT:
            least = min(self.kept[:-NEWEST], key=lambda kept: kept.worth)
            self.kept.remove(least)
            self._dropped.append(least.candidate)
        return True

    @property
    def local_states(self) -> int:
        """How many were reached."""
        return len(self.reached.states) + self.states_beyond.count

    @property
    def pairs(self) -> int:
        """How many pairs of one and an input were reached."""
        return len(self.reached.pairs) + self.pairs_beyond.count

    def _next(self, worth: Sequence[float]) -> Candidate:
        lots, kept = self.lots, self._pick(worth)
        kept.picked += 1
        other = lots.choice(self.kept).candidate.document
        document = changed(kept.candidate.document, other, self.limits, lots, kept.timers_ended_s)
        document = with_key(document, "final_reconcile", None)
        return Candidate(document, kept.candidate.seed if lots.random() < 0.8 else lots.randrange(SEEDS))

    def _pick(self, worth: Sequence[float]) -> Kept:
        """One of the newest as often as any of the others, which are picked by their worth, here summed up; or, more
        often than that, by how near a livelock they came.
        """
        if self.lots.random() < 0.5:
            return self.lots.choice(self.kept[-NEWEST:])
        if self.lots.random() < NEAR:
            near = [kept for kept in self.kept if kept.failed]
            if near:
                return self.lots.choices(near, [kept.nearness for kept in near])[0]
        return self.lots.choices(self.kept, cum_weights=worth)[0]


def _taken_down(numbers: Iterable[int], told_apart: Collection[int], beyond: Beyond) -> int:
    """How many of them are new; they go beyond, if there is no more room."""
    new = [number for number in numbers if number not in told_apart and number not in beyond]
    if len(told_apart) >= MOST:
        for number in new:
            beyond.add(number)
    return len(new)
