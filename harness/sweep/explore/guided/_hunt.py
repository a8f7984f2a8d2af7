"""Search for new behaviour: change scenarios at random, play them, and keep those whose runs reach new states.

The hunt proceeds in rounds. The results of a round depend only on the documents that were stored before the round, and
on the random draws. They do not depend on the speed of the machine, so any number of processes gives the same results.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from random import Random
from typing import NamedTuple

from pydantic import ValidationError

from harness.errors import ScenarioError, UnsupportedError
from harness.proof.coverage import ReachedStates
from harness.proof.coverage.reached import MOST
from harness.run.parallel import FailedTask, sweep
from harness.scenario import Scenario
from harness.sweep.explore._scenario_document import Document, with_key
from harness.sweep.explore.guided._hunt_trial import (
    Divergence,
    FindingIdentity,
    PlayedRun,
    TimerPatterns,
    play_trial,
    with_liveness_phase,
)
from harness.sweep.explore.guided._mutation import MutationLimits, mutate

BITS = 1 << 28
"""Size of the bit field of a `DigestSet` in bits. It takes 32 MiB of memory. After ten million numbers, about one in 30
new numbers is wrongly taken for a member.
"""


class DigestSet:
    """A set of numbers in the form of a bit field. `count` is a lower limit for the number of members."""

    def __init__(self) -> None:
        self.count = 0
        self._bits = bytearray(BITS // 8)

    def __contains__(self, number: int) -> bool:
        place = number % BITS
        return bool(self._bits[place >> 3] >> (place & 7) & 1)

    def add(self, number: int) -> None:
        """Add a number to the set. The set must not contain the number yet."""
        place = number % BITS
        self._bits[place >> 3] |= 1 << (place & 7)
        self.count += 1


ROUND = 64
"""Number of runs in a round."""
MOST_KEPT = 3000
"""Maximum number of stored scenarios. If there are more, the hunt removes the scenario that is least likely to lead to
new states.
"""
MOST_FAILED = 100
MAX_PATTERNS = 100_000
"""Maximum number of stored patterns of failed votes, which take 50 MB. Further patterns do not count as new."""
WORTH_OF_PATTERN = 100
"""Number of new agent states that are worth as much as one new pattern of failed votes."""
NEWEST = 24
NEAR_LIVELOCK = 0.6
SEEDS = 1 << 16


class CandidateRun(NamedTuple):
    """A scenario document to play, and its seed. At the end of the run, a liveness phase without losses and new events
    lets the swarm become idle.
    """

    document: Document
    seed: int

    def scenario(self) -> Scenario:
        """Return the scenario of this candidate. Raises ValidationError if the scenario is invalid."""
        return Scenario.model_validate(with_liveness_phase(self.document))


@dataclass
class KeptRun:
    """A stored scenario document, with the results of its run."""

    candidate: CandidateRun
    new_states: int
    """The number of agent states that no earlier run had reached. A new pattern of failed votes counts as
    WORTH_OF_PATTERN new states.
    """
    steps: int
    """The number of handler runs."""
    failed: int
    """The number of successive failed votes in the pattern of the run. 0 if the pattern was not new."""
    timers_ended_s: tuple[float, ...]
    picked: int = 0

    @property
    def worth(self) -> float:
        """The expected benefit of playing changed copies of this scenario. It grows with the number of new states, and
        falls with the number of earlier copies and with the length of the run.
        """
        return (1 + self.new_states) / (1 + self.picked) / (100 + self.steps)

    @property
    def nearness(self) -> float:
        """The expected benefit of playing changed copies of this scenario, if the hunt searches for an endless cycle.
        The value grows with `failed`. It falls with the number of earlier copies and with the length of the run.
        """
        return self.failed**2 / (1 + self.picked) / (100 + self.steps)


@dataclass(frozen=True)
class NewCoverage:
    """The findings of a run, and the part of its coverage that no earlier run had reached."""

    reached: ReachedStates
    found: tuple[FindingIdentity, ...]
    divergence: Divergence | None
    timers_ended_s: tuple[float, ...]
    failed_votes: TimerPatterns
    unfinished: bool

    @classmethod
    def of(cls, run: PlayedRun, known: ReachedStates) -> "NewCoverage":
        new = ReachedStates(
            run.reached.states - known.states,
            run.reached.pairs - known.pairs,
            run.reached.branches,
            run.reached.steps,
            run.reached.untold,
        )
        return cls(new, run.found, run.divergence, run.timers_ended_s, run.failed_votes, run.unfinished)


@dataclass
class Hunt:
    """The state of a search for new behaviour: its coverage, its findings and its stored documents."""

    limits: MutationLimits
    rng: Random
    reached: ReachedStates = field(default_factory=ReachedStates)
    states_overflow: DigestSet = field(default_factory=DigestSet)
    pairs_overflow: DigestSet = field(default_factory=DigestSet)
    """Digests of (state, input) pairs that runs reached when the exact collection `reached` was full."""
    kept: list[KeptRun] = field(default_factory=list)
    runs: int = 0
    found: dict[FindingIdentity, CandidateRun] = field(default_factory=dict)
    """Finding -> the first run that showed the finding."""
    shown: Counter[FindingIdentity] = field(default_factory=Counter)
    """Finding -> the number of runs that showed the finding."""
    unfinished: int = 0
    """Number of runs without a bad result in which the swarm only needed more time."""
    failures: int = 0
    failed: list[tuple[CandidateRun, str]] = field(default_factory=list)
    """The first runs that have no verdict, with the reasons. `failures` is the number of all runs without a verdict."""
    _dropped: list[CandidateRun] = field(default_factory=list)
    _known_divergences: set[Divergence] = field(default_factory=set)
    """The known ways in which the chains of an idle swarm can differ. If a run ends with a new one, the hunt plays the
    run again with a final reconcile, to see whether the chains become equal.
    """
    _known_patterns: set[TimerPatterns] = field(default_factory=set)
    """The known patterns of failed votes. The first run with a new pattern is stored."""
    _to_reconcile: list[CandidateRun] = field(default_factory=list)

    def begin(self, candidates: Iterable[CandidateRun], jobs: int) -> Iterator[tuple[CandidateRun, bool]]:
        """Run these candidates without changes. Yield each run, and true if the run is stored."""
        yield from self._play(list(candidates), jobs)

    def round(self, jobs: int) -> Iterator[tuple[CandidateRun, bool]]:
        """Change stored documents at random, and run the results. Yield each run, and true if the run is stored."""
        to_reconcile, self._to_reconcile = self._to_reconcile, []
        worth = list(accumulate(kept.worth for kept in self.kept))
        yield from self._play([*to_reconcile, *(self._next(worth) for _ in range(ROUND))], jobs)

    def dropped(self) -> list[CandidateRun]:
        """Return the stored scenarios that were removed since the last call of this method."""
        dropped, self._dropped = self._dropped, []
        return dropped

    def _play(self, candidates: Sequence[CandidateRun], jobs: int) -> Iterator[tuple[CandidateRun, bool]]:
        known = self.reached

        def play(candidate: CandidateRun) -> NewCoverage | None:
            try:
                return NewCoverage.of(play_trial(candidate.scenario(), candidate.seed), known)
            except (ValidationError, ScenarioError, UnsupportedError):  # the changed scenario cannot be played
                return None

        with sweep(candidates, play, jobs) as outcomes:
            for candidate, outcome in outcomes:
                if outcome is None:
                    continue
                self.runs += 1
                if isinstance(outcome, FailedTask):
                    self.failures += 1
                    if len(self.failed) < MOST_FAILED:
                        self.failed.append((candidate, outcome.reason))
                    yield candidate, False
                else:
                    yield candidate, self._learn(candidate, outcome)

    def _learn(self, candidate: CandidateRun, news: NewCoverage) -> bool:
        """Add the results of a run to the coverage. Return true if the run reached a new agent state, a new input in a
        state, a new branch, or a new pattern of failed votes.
        """
        self.unfinished += news.unfinished
        for identity in news.found:
            self.shown[identity] += 1
            self.found.setdefault(identity, candidate)
        if news.divergence is not None and news.divergence not in self._known_divergences:
            self._known_divergences.add(news.divergence)
            document = with_key(candidate.document, "final_reconcile", True)
            self._to_reconcile.append(candidate._replace(document=document))
        new_states = _count_new(news.reached.states, self.reached.states, self.states_overflow)
        pairs = _count_new(news.reached.pairs, self.reached.pairs, self.pairs_overflow)
        branches = any(branch not in self.reached.branches for branch in news.reached.branches)
        self.reached.add(news.reached)
        failed = 0
        if (
            news.failed_votes
            and news.failed_votes not in self._known_patterns
            and len(self._known_patterns) < MAX_PATTERNS
        ):
            self._known_patterns.add(news.failed_votes)
            failed = sum(pattern.count("voting") for pattern in news.failed_votes)
            new_states += WORTH_OF_PATTERN
        if not (new_states or branches or pairs):
            return False
        self.kept.append(KeptRun(candidate, new_states, news.reached.steps, failed, news.timers_ended_s))
        if len(self.kept) > MOST_KEPT:
            least = min(self.kept[:-NEWEST], key=lambda kept: kept.worth)
            self.kept.remove(least)
            self._dropped.append(least.candidate)
        return True

    @property
    def local_states(self) -> int:
        """The number of different agent states that runs have reached."""
        return len(self.reached.states) + self.states_overflow.count

    @property
    def pairs(self) -> int:
        """The number of different pairs of agent state and input that runs have reached."""
        return len(self.reached.pairs) + self.pairs_overflow.count

    def _next(self, worth: Sequence[float]) -> CandidateRun:
        rng, kept = self.rng, self._pick(worth)
        kept.picked += 1
        other = rng.choice(self.kept).candidate.document
        document = mutate(kept.candidate.document, other, self.limits, rng, kept.timers_ended_s)
        document = with_key(document, "final_reconcile", None)
        return CandidateRun(document, kept.candidate.seed if rng.random() < 0.8 else rng.randrange(SEEDS))

    def _pick(self, worth: Sequence[float]) -> KeptRun:
        """Choose a stored document at random.

        In half of all cases, choose one of the newest documents. In a share `NEAR_LIVELOCK` of the other cases, choose
        a document with a new pattern of failed votes, if such a document exists. In the remaining cases, prefer
        documents with a high expected benefit. `worth` contains cumulative sums of the expected benefits.
        """
        if self.rng.random() < 0.5:
            return self.rng.choice(self.kept[-NEWEST:])
        if self.rng.random() < NEAR_LIVELOCK:
            near = [kept for kept in self.kept if kept.failed]
            if near:
                return self.rng.choices(near, [kept.nearness for kept in near])[0]
        return self.rng.choices(self.kept, cum_weights=worth)[0]


def _count_new(numbers: Iterable[int], exact: Collection[int], overflow: DigestSet) -> int:
    """Count the numbers that are in neither collection, and add them to `exact`. If `exact` is full, add them to
    `overflow`.
    """
    new = [number for number in numbers if number not in exact and number not in overflow]
    if len(exact) >= MOST:
        for number in new:
            overflow.add(number)
    return len(new)
