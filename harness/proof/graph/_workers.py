"""All cores look at states, and at what more votes do: forked processes, with the agents and steps known by then.

Each goes on to number local states and zones as it comes upon them. So what one tells another it tells by the other's
number where it knows it, and else by its own, the first time with what that number stands for. Who is told of states
hands them out in their order and takes in what follows them in that order: so all comes out as in one process.
"""

import time
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from harness.errors import HarnessError
from harness.proof._progress_bar import memory_bytes
from harness.proof.graph._expansion import Expansion, expanded
from harness.proof.model._block_renaming import Completed
from harness.proof.model._global_states import AGENTS, ZONE, State, Swarm
from harness.proof.model._known_states import DEAD
from harness.proof.questions._attractor import Check
from harness.proof.questions._extra_votes import UndecidedError, Votes
from harness.run.parallel import FailedTask, Worker, signals_blocked

WAIT_S = 0.5
"""So long it is waited for an answer until memory and time are looked at once more."""
WORTH_A_CREW = 500
"""So many states that have not been looked at are shared among the cores."""
CHUNK = 100
"""So many states, at most, are looked at before they are told of."""
MOST_TOLD = 500_000
"""A process remembers so many states that it has told of; then it tells of them again."""

News = list[tuple[int, Any]]
"""Numbers of whoever tells, and what they stand for."""


class Told(NamedTuple):
    """What one process tells another: `states` one after the other, and what must be known to read them."""

    locals: News
    zones: News
    completed: list[Completed]
    states: "array[int]"


class Forks(NamedTuple):
    """States at rest with several chains, to be told how many more votes they need."""

    told: Told


class Following(NamedTuple):
    """What follows some states. `told` has those that follow and that this process has not told of before, in order.

    `expansions` has for each state how many of them are its own, and what follows it, by where that was told.
    """

    told: Told
    expansions: list[tuple[int, Expansion]]


class Needed(NamedTuple):
    """How many more votes some forks need, as `Votes` says it; None if that is not decided."""

    votes: list[int | None] | None


class Answer(NamedTuple):
    """And what the process has taken until now."""

    answer: Following | Needed
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
        self._completed = len(local.blocks.completed)

    def told(self, states: Sequence[State]) -> Told:
        flat = array("q")
        for state in states:
            flat.extend(state[:ZONE])
            flat.append(self._zones.code(state[ZONE]))
            flat.extend(map(self._locals.code, state[AGENTS:]))
        completed = self._swarm.local.blocks.completed[self._completed :]
        self._completed += len(completed)
        return Told(self._locals.news(), self._zones.news(), completed, flat)

    def heard(self, told: Told) -> list[State]:
        """The states, by our numbers."""
        self._swarm.local.blocks.note_completed(told.completed)
        self._completed = len(self._swarm.local.blocks.completed)
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
        self._telling = count()
        self._votes = Votes(swarm)

    def __call__(self, task: Told | Forks) -> Answer:
        answer = self._needed(task) if isinstance(task, Forks) else self._following(task)
        return Answer(answer, memory_bytes(), time.process_time(), self._swarm.local.steps)

    def _following(self, task: Told) -> Following:
        fresh: list[State] = []
        if len(self._told) >= MOST_TOLD:
            self._told.clear()

        def number_of(state: State) -> int:
            number = self._told.get(state)
            if number is None:
                number = self._told[state] = next(self._telling)
                fresh.append(state)
            return number

        expansions = []
        for state in self._line.heard(task):
            known = len(fresh)
            expansion = expanded(self._swarm, state, number_of)
            expansions.append((len(fresh) - known, expansion))
        return Following(self._line.told(fresh), expansions)

    def _needed(self, task: Forks) -> Needed:
        self._told.clear()  # nobody asks what follows any more
        try:
            return Needed([self._votes.needed(fork) for fork in self._line.heard(task.told)])
        except UndecidedError:
            return Needed(None)


class _Other:
    """One of the processes, as seen from here."""

    def __init__(self, swarm: Swarm) -> None:
        self.memory_bytes = 0.0
        self.processor_s = 0.0
        self.steps = 0
        self._born_with = swarm.local.steps
        self._line = _Line(swarm)
        self._worker: Worker[Told | Forks, Answer] = Worker(_Hand(swarm))
        self._numbers: list[int] = []
        """Of each state that it has told of, here."""

    @property
    def connection(self) -> Connection:
        return self._worker.connection

    def give(self, states: Sequence[State]) -> None:
        self._worker.connection.send(self._line.told(states))

    def give_forks(self, states: Sequence[State]) -> None:
        self._worker.connection.send(Forks(self._line.told(states)))

    def receive(self) -> Following | Needed:
        try:
            answer = self._worker.connection.recv()
        except EOFError:
            raise HarnessError(
                "a worker process was killed, perhaps because memory ran out: lower --memory or --cores"
            ) from None
        if isinstance(answer, HarnessError):
            raise answer
        if isinstance(answer, FailedTask):
            raise HarnessError(f"a worker process failed: {answer.reason}")
        assert isinstance(answer, Answer)
        self.memory_bytes = answer.memory_bytes
        self.processor_s = answer.processor_s
        self.steps = answer.steps - self._born_with
        return answer.answer

    def taken_in(self, answer: Following, first: int, add: Callable[[State, int], int]) -> Iterator[Expansion]:
        """What follows each of the states from number `first` on; new states are added with `add`."""
        fresh = iter(self._line.heard(answer.told))
        numbers = self._numbers
        for parent, (new, expansion) in enumerate(answer.expansions, first):
            for _ in range(new):
                numbers.append(add(next(fresh), parent))
            yield Expansion(
                expansion.ways,
                tuple(tuple(numbers[told] for told in after) for after in expansion.by_timer),
                tuple(numbers[told] for told in expansion.crossing),
            )

    def stop(self) -> None:
        self._worker.stop()


Give = Callable[["_Other", Sequence[State]], None]


class Crew:
    """So many processes, from when they are first asked; a context at whose end they are stopped."""

    def __init__(self, swarm: Swarm, size: int) -> None:
        self._swarm = swarm
        self._size = size
        self._others: list[_Other] = []

    def __enter__(self) -> "Crew":
        return self

    def __exit__(self, *_: object) -> None:
        for other in self._others:
            other.stop()

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

    def is_worth_it(self, waiting: int) -> bool:
        """Whether to ask it, if so many states wait."""
        return self._size > 1 and waiting >= WORTH_A_CREW

    def expansions(
        self, states: Sequence[State], first: int, add: Callable[[State, int], int], check: Check = lambda: None
    ) -> Iterator[Expansion]:
        """What follows each of `states` from number `first` on, in order, also of those that are added meanwhile."""
        for other, number, answer in self._answers(_Other.give, states, check, first):
            assert isinstance(answer, Following)
            yield from other.taken_in(answer, number, add)

    def needed(self, forks: Sequence[State], check: Check) -> Iterator[int | None]:
        """How many more votes each of these states needs, as `Votes` says it. Raises UndecidedError."""
        for _, _, answer in self._answers(_Other.give_forks, forks, check):
            assert isinstance(answer, Needed)
            if answer.votes is None:
                raise UndecidedError
            yield from answer.votes

    def _answers(
        self, give: Give, states: Sequence[State], check: Check, first: int = 0
    ) -> Iterator[tuple[_Other, int, Following | Needed]]:
        """Each with whose it is and the first state that it is of; in order, also of states added meanwhile."""
        if not self._others:
            with signals_blocked():  # what a fork calls lets no Ctrl-C out
                self._others = [_Other(self._swarm) for _ in range(self._size)]
        idle = deque(self._others)
        busy: dict[int, _Other] = {}
        answers: dict[int, tuple[_Other, Following | Needed]] = {}
        due: deque[int] = deque()
        given = first
        while True:
            while idle and given < len(states):
                size = min(CHUNK, max(1, (len(states) - given) // (2 * len(self._others))))
                other = busy[given] = idle.popleft()
                give(other, states[given : given + size])
                due.append(given)
                given += size
            if not due:
                return
            check()
            for number in _answered(busy, wait_for_one=due[0] not in answers):
                other = busy.pop(number)
                answers[number] = other, other.receive()
                idle.append(other)
            if due[0] in answers and not (idle and given < len(states)):  # nobody waits until this is taken in
                number = due.popleft()
                other, answer = answers.pop(number)
                yield other, number, answer


def _answered(busy: Mapping[int, _Other], *, wait_for_one: bool) -> list[int]:
    """Those of the questions, by the number of their first state, that are answered; none if that takes long."""
    ready = wait([other.connection for other in busy.values()], timeout=WAIT_S if wait_for_one else 0)
    return [number for number, other in busy.items() if other.connection in ready]
