"""Run all generated tests with many agents in parallel. Then repeat the suspected failures with a few agents at a time.

Parallel agents compete for the processor, so a wrong answer may be caused by a slow machine. A suspected failure counts
only if it occurs in each of several replays.
"""

import asyncio
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import Any

from harness.conformance._agent_under_test import Start
from harness.conformance._alphabet import INPUTS
from harness.conformance._observation import RecordedDatagram, TestedStep
from harness.conformance._reference_model import ExpectedRun, ReferenceModel
from harness.conformance._state_space import (
    COUNTING_HANDLERS,
    SettingsVariant,
    VectorKey,
    advance,
    changes_nothing,
    handlers_and_messages,
    walk,
)
from harness.conformance._tours import AgentTour, SuspectedFailure, VectorMap
from harness.conformance._udp_lab import AgentEndedError, NoAgentError
from harness.conformance.vectors import VectorSet
from harness.errors import UnsupportedError

MAX_WORKERS = 24
"""Maximum number of agents in parallel."""
WORKERS_PER_PASS = 0.01
"""Each passed test increases the maximum number of parallel agents by this number. This applies after a slow machine
has forced the suite to reduce the maximum.
"""
MIN_WORKERS = 6
"""Minimum number of agents in parallel on a machine that is often late."""
STARTS_AT_ONCE = 4
"""Maximum number of agents that start at the same time. A start needs processor time and delays the agents under
test.
"""
RETRY_WORKERS = 3
"""Number of agents that replay suspected failures in parallel. The number is small, so that the agents do not delay
each other.
"""
MAX_FAILURES_OF_A_KIND = 3
"""Maximum number of suspected failures in which the reference took the same branches. When this number is reached, the
suite omits the remaining vectors with these branches.
"""
MAX_RETRIES_OF_A_KIND = 2
MAX_SUSPICIONS = 24
"""Maximum number of suspected failures that are replayed. When this number is reached, the suite stops its tours."""
MAX_HIDDEN = 16
"""Maximum number of ignored answers that the suite tries, one after another, as the true cause of a failure."""
MAX_PATH = 80
"""Maximum number of inputs when the suite repeats only the last part of a tour."""
REPETITIONS = 2
"""Number of replays in which a suspected failure must occur again."""
MAX_ATTEMPTS = 4
"""Maximum number of replays of one suspected failure. The suite needs more than REPETITIONS replays if the machine is
late in some of them.
"""
MAX_FAILED_STARTS = 3
"""Number of consecutive failed starts after which the suite gives up."""


@dataclass(frozen=True)
class ConfirmedFailure:
    """A generated test that failed each time it was repeated."""

    variant: str
    path: tuple[str, ...]
    """All inputs since the start of the agent. The agent answered the last one wrongly."""
    observation: TestedStep
    exchanges: tuple[RecordedDatagram, ...]
    """All datagrams since the start of the agent."""
    needs_earlier_round: bool = False
    """True if the agent fails only after an earlier vote or reconcile, and not with the shortest sequence of inputs."""
    unexplained_end: str | None = None
    """A phrase that describes the end of the agent. None if the agent did not end, or if a short sequence of inputs
    explains its end.
    """


@dataclass
class VariantResult:
    """The results of all generated tests with one combination of settings."""

    vectors: VectorSet
    passed: set[VectorKey] = field(default_factory=set)
    suspicions: list[SuspectedFailure] = field(default_factory=list)
    failures: list[ConfirmedFailure] = field(default_factory=list)
    unsupported: str | None = None
    set_aside: int = 0


class ReplayVerdict(Enum):
    """The result of a replay in which no failure occurred."""

    RIGHT = auto()
    TOO_LATE = auto()
    """The machine was late, so the replay proves nothing."""


RIGHT, TOO_LATE = ReplayVerdict.RIGHT, ReplayVerdict.TOO_LATE
ReplayOutcome = ConfirmedFailure | ReplayVerdict


class VectorSuite:
    """All generated tests, and the methods that run them. `show_progress` receives the number of passed tests after
    each change.
    """

    def __init__(
        self,
        start: Start,
        generated: Sequence[VectorSet],
        show_progress: Callable[[int], None],
        *,
        workers: int,
        max_suspicions: int = MAX_SUSPICIONS,
    ) -> None:
        self._start = start
        self._all_workers = workers
        self._show_progress = show_progress
        self.variant_results = [VariantResult(vectors) for vectors in generated if vectors.wanted]
        self._maps = [
            VectorMap(
                variant_result.vectors.variant, list(variant_result.vectors.steps), set(variant_result.vectors.wanted)
            )
            for variant_result in self.variant_results
        ]
        self._working: Counter[int] = Counter()
        self._on_tour: Counter[int] = Counter()
        """Index of the settings -> number of active tours. While a tour is active, the suite does not abandon tests
        that no tour can reach, because the active tour may make them reachable.
        """
        self._kinds: Counter[object] = Counter()
        self._failed_starts = 0
        self._max_suspicions = max_suspicions
        self._max_workers = float(workers)
        self._starting = asyncio.Semaphore(STARTS_AT_ONCE)
        self._unexplained_ends: set[str] = set()

    async def run(self, until: float) -> None:
        """Run all tests. Then repeat the tests for which the machine was too late. At the end, repeat the suspected
        failures.

        No test begins after `until`, in seconds of the monotonic clock. Raises NoAgentError if the agent never starts.
        """
        workers = min(self._all_workers, 1 + sum(vector_map.left for vector_map in self._maps) // 10)
        await _run_all([self._work(place, until) for place in range(workers)])
        if not self._suspicious:
            late_keys = iter(
                [
                    (variant_result, key)
                    for variant_result, vector_map in zip(self.variant_results, self._maps, strict=True)
                    for key in vector_map.given_up
                ]
            )
            await _run_all([self._retry_late(late_keys, until) for _ in range(RETRY_WORKERS)])
        to_retry = [
            (variant_result, suspicion)
            for variant_result in self.variant_results
            for suspicion in self._suspicions_to_retry(variant_result)
        ]
        waiting = iter(to_retry[: self._max_suspicions])
        await _run_all([self._retry_suspicions(waiting) for _ in range(RETRY_WORKERS)])

    @property
    def _suspicious(self) -> bool:
        """Return true if the maximum number of suspected failures is reached."""
        return sum(len(variant_result.suspicions) for variant_result in self.variant_results) >= self._max_suspicions

    def _report_progress(self) -> None:
        self._show_progress(sum(len(each.passed) for each in self.variant_results))

    async def _work(self, place: int, until: float) -> None:
        while time.monotonic() < until and not self._suspicious and (number := self._next_variant()) is not None:
            if place >= self._max_workers:
                await asyncio.sleep(0.1)
                continue
            self._working[number] += 1
            try:
                await self._tour(number, until)
            finally:
                self._working[number] -= 1

    def _next_variant(self) -> int | None:
        """Return the index of the settings with the most remaining tests per agent. Return None if no tests remain."""
        shares = [
            (vector_map.left / (self._working[number] + 1), number)
            for number, vector_map in enumerate(self._maps)
            if vector_map.left > len(vector_map.claimed)
        ]
        return max(shares, default=(0, None))[1]

    async def _tour(self, number: int, until: float) -> None:
        variant_result, vector_map = self.variant_results[number], self._maps[number]
        if vector_map.path_from(vector_map.start) is None:
            if not self._on_tour[number]:
                vector_map.give_up()
            await asyncio.sleep(0.1)
            return
        self._on_tour[number] += 1
        try:
            await self._run_tour(variant_result, vector_map, until)
        finally:
            self._on_tour[number] -= 1

    async def _run_tour(self, variant_result: VariantResult, vector_map: VectorMap, until: float) -> None:
        """Start an agent, and test it with one vector after another until it fails or no test remains."""
        try:
            async with self._starting:
                agent = await self._start(variant_result.vectors.variant, False)
        except UnsupportedError as error:
            variant_result.unsupported = str(error)
            vector_map.give_up()
            return
        except AgentEndedError as error:
            self._failed_starts += 1
            if self._failed_starts >= MAX_FAILED_STARTS:
                raise NoAgentError(f"the agent does not start: {error}") from None
            return
        self._failed_starts = 0

        def passed(key: VectorKey) -> None:
            variant_result.passed.add(key)
            self._max_workers = min(self._all_workers, self._max_workers + WORKERS_PER_PASS)
            self._report_progress()

        try:
            suspicion = await AgentTour(vector_map, agent, passed).run(until)
            if not agent.reference_follows:  # the machine is late, so fewer agents should run in parallel
                self._max_workers = max(MIN_WORKERS, self._max_workers - 1)
            if suspicion is not None:
                self._add_suspicion(variant_result, vector_map, suspicion)
        finally:
            await agent.close()

    def _add_suspicion(self, variant_result: VariantResult, vector_map: VectorMap, suspicion: SuspectedFailure) -> None:
        variant_result.suspicions.append(suspicion)
        vector_map.avoid(suspicion.observation.key)
        kind = handlers_and_messages(suspicion.observation.outcome)
        self._kinds[kind] += 1
        if self._kinds[kind] >= MAX_FAILURES_OF_A_KIND:
            alike = [
                key
                for key, step in variant_result.vectors.wanted.items()
                if handlers_and_messages(step.outcome) == kind
            ]
            variant_result.set_aside += sum(vector_map.take(key) for key in alike)

    @staticmethod
    def _suspicions_to_retry(variant_result: VariantResult) -> Iterator[SuspectedFailure]:
        """Yield the suspected failures, sorted by number of inputs. Yield at most MAX_RETRIES_OF_A_KIND failures with
        the same branches.
        """
        kinds: Counter[object] = Counter()
        for suspicion in sorted(variant_result.suspicions, key=lambda suspicion: len(suspicion.path)):
            kind = handlers_and_messages(suspicion.observation.outcome)
            kinds[kind] += 1
            if kinds[kind] <= MAX_RETRIES_OF_A_KIND:
                yield suspicion

    # Replays with few agents at a time

    async def _retry_late(self, late_keys: Iterator[tuple[VariantResult, VectorKey]], until: float) -> None:
        """Repeat the tests that were abandoned because the machine was too late at each attempt."""
        for variant_result, key in late_keys:
            if time.monotonic() >= until:
                return
            step = variant_result.vectors.wanted[key]
            outcome = await self._play_repeatedly(variant_result.vectors.variant, (*step.path, key.input))
            if isinstance(outcome, ConfirmedFailure):
                variant_result.failures.append(outcome)
                variant_result.passed.discard(outcome.observation.key)
            elif outcome is RIGHT:
                variant_result.passed.add(key)
                self._report_progress()

    async def _retry_suspicions(self, waiting: Iterator[tuple[VariantResult, SuspectedFailure]]) -> None:
        for variant_result, suspicion in waiting:
            variant_result.passed.discard(suspicion.observation.key)
            if (
                suspicion.observation.ended is not None
                and _kind_of_end(suspicion.observation.ended) in self._unexplained_ends
            ):
                continue
            outcomes = [outcome async for outcome in self._retry_variants(variant_result, suspicion)]
            failures = [outcome for outcome in outcomes if isinstance(outcome, ConfirmedFailure)]
            if failures:
                variant_result.failures.append(failures[0])
                variant_result.passed.discard(failures[0].observation.key)
            elif (ended := suspicion.observation.ended) is not None:
                if _kind_of_end(ended) not in self._unexplained_ends:
                    self._unexplained_ends.add(_kind_of_end(ended))
                    variant_result.failures.append(
                        _unexplained_failure(variant_result.vectors.variant, suspicion, ended)
                    )
            elif all(outcome is RIGHT for outcome in outcomes):
                variant_result.passed.add(suspicion.observation.key)  # the machine was at fault

    async def _retry_variants(
        self, variant_result: VariantResult, suspicion: SuspectedFailure
    ) -> AsyncIterator[ReplayOutcome]:
        """Test a suspected failure with several sequences of inputs, until the agent fails in one. Yield the results. A
        sequence with an additional answer gives a result only if the agent fails.

        The first sequence is the shortest sequence that leads to the state. The next sequences contain an additional
        answer that the agent must ignore. The last sequences are the ends of the original sequence.
        """
        variant = variant_result.vectors.variant
        name = suspicion.path[-1]
        step = variant_result.vectors.by_key.get(suspicion.observation.key)
        if step is not None:
            yield (outcome := await self._play_repeatedly(variant, (*step.path, name)))
            if isinstance(outcome, ConfirmedFailure):
                return
            for additional in list(dict.fromkeys(reversed(suspicion.path[:-1])))[:MAX_HIDDEN]:
                run = _single_run(variant, step.path, additional)
                if run is not None and run.handler in COUNTING_HANDLERS:
                    outcome = await self._play_repeatedly(variant, (*step.path, additional, name))
                    if isinstance(outcome, ConfirmedFailure):
                        yield replace(outcome, observation=replace(outcome.observation, hidden_run=run))
                        return
        if suspicion.observation.ended is not None:  # the number of all inputs may have ended it, not the last ones
            return
        for path in _path_tails(variant, suspicion.path):
            outcome = await self._play_repeatedly(variant, path)
            if isinstance(outcome, ConfirmedFailure):
                yield await self._find_miscounted(variant, path, outcome, needs_earlier_round=step is not None)
                return
            yield outcome

    async def _find_miscounted(
        self, variant: SettingsVariant, path: Sequence[str], failure: ConfirmedFailure, *, needs_earlier_round: bool
    ) -> ConfirmedFailure:
        """Find out whether the agent counted answers that it must ignore. For each handler of such answers, repeat the
        inputs without these answers. If the failure disappears, return it with this handler run as its cause. Otherwise
        return it with the given value of `needs_earlier_round`.
        """
        counted = _ignored_answers(variant, path)
        for handler in dict.fromkeys(run.handler for run in counted.values()):
            others = [
                name for place, name in enumerate(path) if place not in counted or counted[place].handler != handler
            ]
            if await self._play_repeatedly(variant, others) is RIGHT:
                run = next(run for run in reversed(counted.values()) if run.handler == handler)
                return replace(failure, observation=replace(failure.observation, hidden_run=run))
        return replace(failure, needs_earlier_round=needs_earlier_round)

    async def _play_repeatedly(self, variant: SettingsVariant, path: Sequence[str]) -> ReplayOutcome:
        """Give these inputs to new agents, several times. If an agent is right at least once, return RIGHT. Otherwise
        return the failure. Return TOO_LATE if the machine was late in too many replays.
        """
        failures = 0
        for _ in range(MAX_ATTEMPTS):
            outcome = await self.play(variant, path)
            if outcome is RIGHT:
                return RIGHT
            if isinstance(outcome, ConfirmedFailure):
                failures += 1
                if failures >= REPETITIONS:
                    return outcome
        return TOO_LATE

    async def play(self, variant: SettingsVariant, path: Sequence[str]) -> ReplayOutcome:
        """Give these inputs to a new agent. Return the first failure of the agent, or RIGHT if the agent made no error.
        Return TOO_LATE if the machine was late, or if the agent could not be started.
        """
        try:
            agent = await self._start(variant, True)
        except (AgentEndedError, UnsupportedError):
            return TOO_LATE
        try:
            for number, name in enumerate(path, 1):
                observation = await agent.step(INPUTS[name])
                if observation is not None and observation.wrong:
                    failure = ConfirmedFailure(variant.name, tuple(path[:number]), observation, agent.exchanges())
                    return TOO_LATE if observation.late else failure
        finally:
            await agent.close()
        return RIGHT


def _kind_of_end(ended: str) -> str:
    """Return a phrase about the end of an agent, such as "it hangs" or "it ended with status 1"."""
    return ended.partition(":")[0]


def _unexplained_failure(variant: SettingsVariant, suspicion: SuspectedFailure, ended: str) -> ConfirmedFailure:
    return ConfirmedFailure(
        variant.name, suspicion.path, suspicion.observation, suspicion.exchanges, unexplained_end=ended
    )


def _single_run(variant: SettingsVariant, path: tuple[str, ...], name: str) -> ExpectedRun | None:
    """Return the handler run that the input `name` causes after the inputs in `path`. Return None if it causes none or
    more than one.
    """
    model, now = walk(variant, path)
    advanced = advance(model, INPUTS[name], now)
    return advanced[0].runs[0] if advanced is not None and len(advanced[0].runs) == 1 else None


def _ignored_answers(variant: SettingsVariant, path: Sequence[str]) -> dict[int, ExpectedRun]:
    """Index of an input -> the handler run that must ignore it. Contains only inputs that are answers which the agent
    must ignore.
    """
    model, now = ReferenceModel(variant.settings), 0.0
    uncounted = {}
    for place, name in enumerate(path[:-1]):
        advanced = advance(model, INPUTS[name], now)
        if advanced is not None:
            outcome, now = advanced
            if outcome.runs and outcome.runs[0].handler in COUNTING_HANDLERS and changes_nothing(outcome):
                uncounted[place] = outcome.runs[0]
    return uncounted


def _path_tails(variant: SettingsVariant, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield parts of these inputs that end with the last input, from the shortest part to all inputs. Each part begins
    at an input before which the agent was idle.

    Parts with more than MAX_PATH inputs are omitted.
    """
    model, now = ReferenceModel(variant.settings), 0.0
    idle = [0]
    for number, name in enumerate(path[:-1], 1):
        advanced = advance(model, INPUTS[name], now)
        if advanced is not None:
            now = advanced[1]
        if model.state.idle and not model.state.blocks_to_be_committed:
            idle.append(number)
    for place in (*idle[:-4:-1], 0):
        if len(path) - place <= MAX_PATH:
            yield path[place:]


async def _run_all(work: Sequence[Coroutine[Any, Any, None]]) -> None:
    """Run all coroutines in parallel. If one raises an error, cancel the other coroutines and raise this error."""
    try:
        async with asyncio.TaskGroup() as group:
            for each in work:
                group.create_task(each)
    except BaseExceptionGroup as errors:
        error: BaseException = errors
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        raise error from None
