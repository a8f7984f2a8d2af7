"""All generated vectors, by agents side by side; then what is suspected, alone."""

import asyncio
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import Any

from harness.conformance._alphabet import INPUTS
from harness.conformance._observation import Exchange, Seen
from harness.conformance._reference_model import Model, Run
from harness.conformance._state_space import COUNTING, Pair, Variant, advance, in_short, is_unchanged, walk
from harness.conformance._subject import Start
from harness.conformance._tours import Map, Suspicion, Tour
from harness.conformance._udp_lab import AgentEndedError, NoAgentError
from harness.conformance.vectors import Vectors
from harness.errors import UnsupportedError

SIDE_BY_SIDE = 24
MORE_ROOM = 0.01
"""For another agent, with each vector that passes."""
FEWEST = 6
"""Side by side, where the machine is late again and again."""
STARTS_AT_ONCE = 4
"""An agent that starts needs the processor, and those that are under test would be late."""
ALONE_AT_ONCE = 3
"""What is suspected is tried again by so few agents that none is in another's way."""
FAILURES_OF_A_KIND = 3
"""After so many suspicions further vectors in which the same branches are to be taken are set aside."""
MOST_SUSPICIONS_OF_A_KIND = 2
MOST_SUSPICIONS = 24
"""That are tried again."""
MOST_HIDDEN = 16
LONGEST_WAY = 80
TIMES = 2
"""A failure is one only if it comes so often."""
MOST_TIMES = 4
"""That it is tried, where the machine was late."""
STARTS_IN_VAIN = 3


@dataclass(frozen=True)
class Failure:
    """A vector that failed alone, each time that it was tried; `way` are all inputs, of which the last was wrong."""

    variant: str
    way: tuple[str, ...]
    seen: Seen
    exchanges: tuple[Exchange, ...]
    """What crossed the air."""
    of_an_earlier_round: bool = False
    """It fails only after what was long over."""
    unexplained_end: str | None = None
    """How the agent ended, if no short way to its last input ends it."""


@dataclass
class Tally:
    """What came of a variant's vectors."""

    vectors: Vectors
    passed: set[Pair] = field(default_factory=set)
    suspicions: list[Suspicion] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    unsupported: str | None = None
    set_aside: int = 0


class Verdict(Enum):
    """Of a way on which nothing failed."""

    RIGHT = auto()
    TOO_LATE = auto()
    """The machine was late: nothing can be said."""


RIGHT, TOO_LATE = Verdict.RIGHT, Verdict.TOO_LATE
Outcome = Failure | Verdict


class Suite:
    """`told` is called with how many vectors have been seen, whenever that changes."""

    def __init__(
        self,
        start: Start,
        generated: Sequence[Vectors],
        told: Callable[[int], None],
        *,
        side_by_side: int,
        enough: int = MOST_SUSPICIONS,
    ) -> None:
        self._start = start
        self._side_by_side = side_by_side
        self._told = told
        self.tallies = [Tally(vectors) for vectors in generated if vectors.wanted]
        self._maps = [
            Map(tally.vectors.variant, list(tally.vectors.steps), set(tally.vectors.wanted)) for tally in self.tallies
        ]
        self._at_work: Counter[int] = Counter()
        self._on_tour: Counter[int] = Counter()
        """Of those at work, who may yet see something; the others wait for that."""
        self._kinds: Counter[object] = Counter()
        self._in_vain = 0
        self._enough = enough
        self._room = float(side_by_side)
        self._starting = asyncio.Semaphore(STARTS_AT_ONCE)
        self._unexplained_ends: set[str] = set()

    async def run(self, until: float) -> None:
        """All vectors, until that second of the monotonic clock, the last of them alone; then what is suspected.

        Raises NoAgentError if the agent never starts.
        """
        workers = min(self._side_by_side, 1 + sum(atlas.left for atlas in self._maps) // 10)
        await _together([self._work(place, until) for place in range(workers)])
        if not self._suspicious:
            missed = iter(
                [
                    (tally, pair)
                    for tally, atlas in zip(self.tallies, self._maps, strict=True)
                    for pair in atlas.given_up
                ]
            )
            await _together([self._try_with_time(missed, until) for _ in range(ALONE_AT_ONCE)])
        once_more = [(tally, suspicion) for tally in self.tallies for suspicion in self._worth(tally)]
        waiting = iter(once_more[: self._enough])
        await _together([self._try_again(waiting) for _ in range(ALONE_AT_ONCE)])

    @property
    def _suspicious(self) -> bool:
        """Whether there are as many suspicions as are tried again."""
        return sum(len(tally.suspicions) for tally in self.tallies) >= self._enough

    def _tell(self) -> None:
        self._told(sum(len(each.passed) for each in self.tallies))

    async def _work(self, place: int, until: float) -> None:
        while time.monotonic() < until and not self._suspicious and (number := self._most_left()) is not None:
            if place >= self._room:
                await asyncio.sleep(0.1)
                continue
            self._at_work[number] += 1
            try:
                await self._tour(number, until)
            finally:
                self._at_work[number] -= 1

    def _most_left(self) -> int | None:
        """The variant in which an agent finds most that is yet to be seen."""
        shares = [
            (atlas.left / (self._at_work[number] + 1), number)
            for number, atlas in enumerate(self._maps)
            if atlas.left > len(atlas.claimed)
        ]
        return max(shares, default=(0, None))[1]

    async def _tour(self, number: int, until: float) -> None:
        tally, atlas = self.tallies[number], self._maps[number]
        if atlas.way_from(atlas.start) is None:
            if not self._on_tour[number]:
                atlas.give_up()
            await asyncio.sleep(0.1)
            return
        self._on_tour[number] += 1
        try:
            await self._life(tally, atlas, until)
        finally:
            self._on_tour[number] -= 1

    async def _life(self, tally: Tally, atlas: Map, until: float) -> None:
        """Of an agent, as long as its tour lasts."""
        try:
            async with self._starting:
                subject = await self._start(tally.vectors.variant, False)
        except UnsupportedError as error:
            tally.unsupported = str(error)
            atlas.give_up()
            return
        except AgentEndedError as error:
            self._in_vain += 1
            if self._in_vain >= STARTS_IN_VAIN:
                raise NoAgentError(f"the agent does not start: {error}") from None
            return
        self._in_vain = 0

        def passed(pair: Pair) -> None:
            tally.passed.add(pair)
            self._room = min(self._side_by_side, self._room + MORE_ROOM)
            self._tell()

        try:
            suspicion = await Tour(atlas, subject, passed).go_on(until)
            if not subject.in_step:  # an agent was lost because all are late: make room
                self._room = max(FEWEST, self._room - 1)
            if suspicion is not None:
                self._suspect(tally, atlas, suspicion)
        finally:
            await subject.close()

    def _suspect(self, tally: Tally, atlas: Map, suspicion: Suspicion) -> None:
        tally.suspicions.append(suspicion)
        atlas.avoid(suspicion.seen.pair)
        kind = in_short(suspicion.seen.outcome)
        self._kinds[kind] += 1
        if self._kinds[kind] >= FAILURES_OF_A_KIND:
            alike = [pair for pair, step in tally.vectors.wanted.items() if in_short(step.outcome) == kind]
            tally.set_aside += sum(atlas.take(pair) for pair in alike)

    @staticmethod
    def _worth(tally: Tally) -> Iterator[Suspicion]:
        """A few of each kind, the shortest ways first."""
        kinds: Counter[object] = Counter()
        for suspicion in sorted(tally.suspicions, key=lambda suspicion: len(suspicion.way)):
            kind = in_short(suspicion.seen.outcome)
            kinds[kind] += 1
            if kinds[kind] <= MOST_SUSPICIONS_OF_A_KIND:
                yield suspicion

    # Alone

    async def _try_with_time(self, missed: Iterator[tuple[Tally, Pair]], until: float) -> None:
        """What could not be seen beside others, because the machine was late."""
        for tally, pair in missed:
            if time.monotonic() >= until:
                return
            step = tally.vectors.wanted[pair]
            outcome = await self._repeated(tally.vectors.variant, (*step.way, pair.input))
            if isinstance(outcome, Failure):
                tally.failures.append(outcome)
                tally.passed.discard(outcome.seen.pair)
            elif outcome is RIGHT:
                tally.passed.add(pair)
                self._tell()

    async def _try_again(self, waiting: Iterator[tuple[Tally, Suspicion]]) -> None:
        for tally, suspicion in waiting:
            tally.passed.discard(suspicion.seen.pair)
            if suspicion.seen.ended is not None and _kind_of_end(suspicion.seen.ended) in self._unexplained_ends:
                continue
            outcomes = [outcome async for outcome in self._alone(tally, suspicion)]
            failures = [outcome for outcome in outcomes if isinstance(outcome, Failure)]
            if failures:
                tally.failures.append(failures[0])
                tally.passed.discard(failures[0].seen.pair)
            elif (ended := suspicion.seen.ended) is not None:
                if _kind_of_end(ended) not in self._unexplained_ends:
                    self._unexplained_ends.add(_kind_of_end(ended))
                    tally.failures.append(_unexplained(tally.vectors.variant, suspicion, ended))
            elif all(outcome is RIGHT for outcome in outcomes):
                tally.passed.add(suspicion.seen.pair)  # it was the machine

    async def _alone(self, tally: Tally, suspicion: Suspicion) -> AsyncIterator[Outcome]:
        """By the shortest way; after each input on the way that should have changed nothing; and at last as it was.

        Until it fails.
        """
        variant = tally.vectors.variant
        name = suspicion.way[-1]
        step = tally.vectors.by_pair.get(suspicion.seen.pair)
        if step is not None:
            yield (outcome := await self._repeated(variant, (*step.way, name)))
            if isinstance(outcome, Failure):
                return
            for hidden in list(dict.fromkeys(reversed(suspicion.way[:-1])))[:MOST_HIDDEN]:
                run = _run_without_effect(variant, step.way, hidden)
                if run is not None and run.handler in COUNTING:
                    outcome = await self._repeated(variant, (*step.way, hidden, name))
                    if isinstance(outcome, Failure):
                        yield replace(outcome, seen=replace(outcome.seen, hidden=run))
                        return
        if suspicion.seen.ended is not None:  # all its inputs may have ended it, not the last ones
            return
        for way in _tails(variant, suspicion.way):
            outcome = await self._repeated(variant, way)
            if isinstance(outcome, Failure):
                yield await self._what_counted(variant, way, outcome, of_an_earlier_round=step is not None)
                return
            yield outcome

    async def _what_counted(
        self, variant: Variant, way: Sequence[str], failure: Failure, *, of_an_earlier_round: bool
    ) -> Failure:
        """The failure with what should not have counted on its way, without which it does not fail."""
        counted = _uncounted(variant, way)
        for handler in dict.fromkeys(run.handler for run in counted.values()):
            others = [
                name for place, name in enumerate(way) if place not in counted or counted[place].handler != handler
            ]
            if await self._repeated(variant, others) is RIGHT:
                run = next(run for run in reversed(counted.values()) if run.handler == handler)
                return replace(failure, seen=replace(failure.seen, hidden=run))
        return replace(failure, of_an_earlier_round=of_an_earlier_round)

    async def _repeated(self, variant: Variant, way: Sequence[str]) -> Outcome:
        """Right if it is so once; a failure if it fails each time; too late if nothing else came."""
        failures = 0
        for _ in range(MOST_TIMES):
            outcome = await self.play(variant, way)
            if outcome is RIGHT:
                return RIGHT
            if isinstance(outcome, Failure):
                failures += 1
                if failures >= TIMES:
                    return outcome
        return TOO_LATE

    async def play(self, variant: Variant, way: Sequence[str]) -> Outcome:
        """An agent is given all these inputs: where it was wrong first, if it was not the machine that was late."""
        try:
            subject = await self._start(variant, True)
        except (AgentEndedError, UnsupportedError):
            return TOO_LATE
        try:
            for number, name in enumerate(way, 1):
                seen = await subject.step(INPUTS[name])
                if seen is not None and seen.wrong:
                    failure = Failure(variant.name, tuple(way[:number]), seen, subject.exchanges())
                    return TOO_LATE if seen.late else failure
        finally:
            await subject.close()
        return RIGHT


def _kind_of_end(ended: str) -> str:
    """Return "it hangs", or "it ended with status 1"."""
    return ended.partition(":")[0]


def _unexplained(variant: Variant, suspicion: Suspicion, ended: str) -> Failure:
    return Failure(variant.name, suspicion.way, suspicion.seen, suspicion.exchanges, unexplained_end=ended)


def _run_without_effect(variant: Variant, way: tuple[str, ...], name: str) -> Run | None:
    """What comes of an input after this way, if that is only one handler's run."""
    model, now = walk(variant, way)
    advanced = advance(model, INPUTS[name], now)
    return advanced[0].runs[0] if advanced is not None and len(advanced[0].runs) == 1 else None


def _uncounted(variant: Variant, way: Sequence[str]) -> dict[int, Run]:
    """The runs on a way that look at an answer and must not count it, by their place."""
    model, now = Model(variant.settings), 0.0
    uncounted = {}
    for place, name in enumerate(way[:-1]):
        advanced = advance(model, INPUTS[name], now)
        if advanced is not None:
            outcome, now = advanced
            if outcome.runs and outcome.runs[0].handler in COUNTING and is_unchanged(outcome):
                uncounted[place] = outcome.runs[0]
    return uncounted


def _tails(variant: Variant, way: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """The last inputs of a way, since the agent was idle, or since it was so before that; and all, if they are few."""
    model, now = Model(variant.settings), 0.0
    idle = [0]
    for number, name in enumerate(way[:-1], 1):
        advanced = advance(model, INPUTS[name], now)
        if advanced is not None:
            now = advanced[1]
        if model.state.idle and not model.state.blocks_to_be_committed:
            idle.append(number)
    for place in (*idle[:-4:-1], 0):
        if len(way) - place <= LONGEST_WAY:
            yield way[place:]


async def _together(work: Sequence[Coroutine[Any, Any, None]]) -> None:
    """All of it; the first error ends all."""
    try:
        async with asyncio.TaskGroup() as group:
            for each in work:
                group.create_task(each)
    except BaseExceptionGroup as errors:
        error: BaseException = errors
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        raise error from None
