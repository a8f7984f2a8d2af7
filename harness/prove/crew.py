"""All cores look at states: forked processes, each with the agents and the memory of steps that it has at its birth.

Each goes on to number local states and zones as it comes upon them. So what one tells another it tells by the other's
number where it knows it, and else by its own, the first time with what that number stands for. Who is told of states
hands them out in their order and takes in what follows them in that order: so all comes out as in one process.
"""

import time
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from harness.errors import HarnessError
from harness.prove.expansion import Expansion, expanded
from harness.prove.local import DEAD
from harness.prove.progress import memory_bytes
from harness.prove.swarm import AGENTS, ZONE, State, Swarm
from harness.run.sweep import Failed, Worker

CHUNK = 100
"""So many states, at most, are looked at before they are told of."""

News = list[tuple[int, Any]]
"""Numbers of whoever tells, and what they stand for."""


class Told(NamedTuple):
    """What one process tells another: `states` one after the other, and what must be known to read them."""

    locals: News
    zones: News
    completed: list[tuple[bytes, int, int]]
    states: "array[int]"


class Answer(NamedTuple):
    """What follows some states. `told` has those that follow and that this process has not told of before, in order.

    `expansions` has for each state how many of them are its own, and what follows it, by where that was told.
    """

    told: Told
    expansions: list[tuple[int, Expansion]]
    memory_bytes: float
    processor_s: float
    steps: int


class _Numbers:
    """The numbers that two processes have for the same things, as one of them sees it: equal up to `alike`."""

    def __init__(self, alike: int, content: Callable[[int], Any], adopt: Callable[[Any], int]) -> None:
        self._content = content
        self._adopt = adopt
        self._codes: dict[int, int] = {DEAD: DEAD, **{number: number for number in range(alike)}}
        self._ours: dict[int, int] = {}
        self._news: News = []

    def code(self, ours: int) -> int:
        """The number that the other has for it; or less than -1: ours."""
        code = self._codes.get(ours)
        if code is None:
            code = self._codes[ours] = -ours - 2
            self._news.append((ours, self._content(ours)))
        return code

    def ours(self, code: int) -> int:
        return code if code >= DEAD else self._ours[-code - 2]

    def news(self) -> News:
        news, self._news = self._news, []
        return news

    def learn(self, news: News) -> None:
        for theirs, content in news:
            ours = self._ours[theirs] = self._adopt(content)
            self._codes.setdefault(ours, theirs)


class _Line:
    """The line between two processes that were one when it was laid, as one of them sees it."""

    def __init__(self, swarm: Swarm) -> None:
        local, zones = swarm.local, swarm.zones
        self._swarm = swarm
        self._locals = _Numbers(len(local.known), local.content, local.adopt)
        self._zones = _Numbers(len(zones), zones.matrix, zones.adopt)
        self._completed = len(local.completed)

    def told(self, states: Sequence[State]) -> Told:
        flat = array("q")
        for state in states:
            flat.extend(state[:ZONE])
            flat.append(self._zones.code(state[ZONE]))
            flat.extend(map(self._locals.code, state[AGENTS:]))
        completed = self._swarm.local.completed[self._completed :]
        self._completed += len(completed)
        return Told(self._locals.news(), self._zones.news(), completed, flat)

    def heard(self, told: Told) -> list[State]:
        """The states, by our numbers."""
        self._swarm.local.note_completed(told.completed)
        self._completed = len(self._swarm.local.completed)
        self._locals.learn(told.locals)
        self._zones.learn(told.zones)
        flat, size = told.states, AGENTS + self._swarm.bounds.agents
        return [
            (
                *flat[at : at + ZONE],
                self._zones.ours(flat[at + ZONE]),
                *map(self._locals.ours, flat[at + AGENTS : at + size]),
            )
            for at in range(0, len(flat), size)
        ]


class _Hand:
    """In a process of its own: looks at the states that it is told of."""

    def __init__(self, swarm: Swarm) -> None:
        self._swarm = swarm
        self._line = _Line(swarm)
        self._told: dict[State, int] = {}

    def __call__(self, task: Told) -> Answer:
        fresh: list[State] = []

        def number_of(state: State) -> int:
            number = self._told.get(state)
            if number is None:
                number = self._told[state] = len(self._told)
                fresh.append(state)
            return number

        expansions = []
        for state in self._line.heard(task):
            known = len(fresh)
            expansion = expanded(self._swarm, state, number_of)
            expansions.append((len(fresh) - known, expansion))
        return Answer(self._line.told(fresh), expansions, memory_bytes(), time.process_time(), self._swarm.local.steps)


class _Other:
    """One of the processes, as seen from here."""

    def __init__(self, swarm: Swarm) -> None:
        self.memory_bytes = 0.0
        self.processor_s = 0.0
        self.steps = 0
        self._born_with = swarm.local.steps
        self._line = _Line(swarm)
        self._worker: Worker[Told, Answer] = Worker(_Hand(swarm))
        self._numbers: list[int] = []
        """Of each state that it has told of, here."""

    def give(self, states: Sequence[State]) -> None:
        self._worker.connection.send(self._line.told(states))

    def receive(self) -> Answer:
        try:
            answer = self._worker.connection.recv()
        except EOFError:
            raise HarnessError(
                "a process that looked at states was killed, maybe for want of memory: lower --memory or --cores"
            ) from None
        if isinstance(answer, HarnessError):
            raise answer
        if isinstance(answer, Failed):
            raise HarnessError(f"a process that looked at states failed: {answer.reason}")
        assert isinstance(answer, Answer)
        self.memory_bytes = answer.memory_bytes
        self.processor_s = answer.processor_s
        self.steps = answer.steps - self._born_with
        return answer

    def taken_in(self, answer: Answer, first: int, add: Callable[[State, int], int]) -> Iterator[Expansion]:
        """What follows each of the states from number `first` on; new states are added with `add`."""
        fresh = iter(self._line.heard(answer.told))
        numbers = self._numbers
        for parent, (count, expansion) in enumerate(answer.expansions, first):
            for _ in range(count):
                numbers.append(add(next(fresh), parent))
            yield Expansion(
                expansion.ways,
                tuple(tuple(numbers[told] for told in after) for after in expansion.by_timer),
                tuple(numbers[told] for told in expansion.crossing),
            )

    def stop(self) -> None:
        self._worker.stop()


class Crew:
    """So many processes; to be stopped."""

    def __init__(self, swarm: Swarm, size: int) -> None:
        self._others = [_Other(swarm) for _ in range(size)]

    @property
    def memory_bytes(self) -> float:
        return sum(other.memory_bytes for other in self._others)

    @property
    def processor_s(self) -> float:
        return sum(other.processor_s for other in self._others)

    @property
    def steps(self) -> int:
        """That they have computed."""
        return sum(other.steps for other in self._others)

    def expansions(self, states: Sequence[State], first: int, add: Callable[[State, int], int]) -> Iterator[Expansion]:
        """What follows each of `states` from number `first` on, in order, also of those that are added meanwhile."""
        idle = deque(self._others)
        busy: deque[tuple[_Other, int]] = deque()
        given = first
        while True:
            while idle and given < len(states):
                given += self._give(idle, busy, states, given)
            if not busy:
                return
            other, number = busy.popleft()
            answer = other.receive()
            idle.append(other)
            if given < len(states):  # it need not wait until this is taken in
                given += self._give(idle, busy, states, given)
            yield from other.taken_in(answer, number, add)

    def _give(
        self, idle: "deque[_Other]", busy: "deque[tuple[_Other, int]]", states: Sequence[State], given: int
    ) -> int:
        size = min(CHUNK, max(1, (len(states) - given) // (2 * len(self._others))))
        other = idle.popleft()
        other.give(states[given : given + size])
        busy.append((other, given))
        return size

    def stop(self) -> None:
        for other in self._others:
            other.stop()
