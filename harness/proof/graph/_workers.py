"""Explore states in worker processes on all processor cores.

The workers are forked processes. Each worker starts with the agents and steps that are known at the fork. After the
fork, each process numbers new local states and zones itself, so the same state has different numbers in different
processes. A message between two processes identifies a state by the receiver's number if the sender knows this number.
Otherwise the message contains the sender's number. When a process sends its own number of a state for the first time,
it adds the definition of the state.

The main process distributes the states in order, and adds their successors in the same order. The result is therefore
the same as with one process.
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
from harness.proof.graph._expansion import StateExpansion, expanded
from harness.proof.model._block_renaming import Completed
from harness.proof.model._flaws import PropertyViolation
from harness.proof.model._global_states import AGENTS, ZONE, ModelSwarm, State
from harness.proof.model._known_states import DEAD
from harness.proof.questions._attractor import Check
from harness.proof.questions._extra_votes import ExtraVotes, UndecidedError
from harness.run.parallel import FailedTask, WorkerProcess, signals_blocked

WAIT_S = 0.5
"""Maximum number of seconds to wait for an answer of a worker before memory and time are checked again."""
WORTH_WORKERS = 500
"""Minimum number of waiting states for which worker processes are used. For fewer states, they would save no time."""
CHUNK = 100
"""Maximum number of states that the main process puts into one task of a worker."""
MAX_REPORTED = 500_000
"""Maximum number of states that a worker remembers having sent to the main process. Above this number, the worker
forgets them and sends them again.
"""

Definitions = list[tuple[int, Any]]
"""Number of a state in the sending process -> definition of the state."""


class StateBatch(NamedTuple):
    """States that one process sends to another process, in a flat array of numbers, together with the definitions that
    the receiver does not have yet.
    """

    locals: Definitions
    zones: Definitions
    completed: list[Completed]
    states: "array[int]"


class ForkedStates(NamedTuple):
    """A task for a worker: to count the votes that lead to one chain.

    `batch` contains idle states in which agents have different chains. The worker answers with a `NeededVotes`.
    """

    batch: StateBatch


class SuccessorBatch(NamedTuple):
    """A worker's answer: the successors of some states. `batch` contains the successors that this worker has not sent
    before.

    `expansions` contains for each state the number of new successors in `batch`, and its `StateExpansion` with the
    worker's state numbers.
    """

    batch: StateBatch
    expansions: list[tuple[int, StateExpansion]]


class NeededVotes(NamedTuple):
    """A worker's answer: the number of further votes that each state needs until all chains are equal. `votes` is None
    if the search reached its limit.
    """

    votes: list[int | PropertyViolation | None] | None


class WorkerAnswer(NamedTuple):
    """An answer of a worker process, with the time and memory that the worker has used so far."""

    answer: SuccessorBatch | NeededVotes
    memory_bytes: float
    processor_s: float
    steps: int


class _NumberTranslator:
    """A translator between the numbers of two processes for the same states. Numbers below `alike` were assigned before
    the fork, so they are equal in both processes.
    """

    def __init__(self, alike: int, content: Callable[[int], Any], adopt: Callable[[Any], int]) -> None:
        self._content = content
        self._adopt = adopt
        self._codes: dict[int, int] = {DEAD: DEAD, **{number: number for number in range(alike)}}
        self._ours: dict[int, int] = {}
        self._new_definitions: Definitions = []

    def code(self, ours: int) -> int:
        """Convert the number of a state in this process to a number for the other process. The result is the other
        process's own number, if it is known. Otherwise it is a value below -1 that encodes the number in this process.
        """
        code = self._codes.get(ours)
        if code is None:
            code = self._codes[ours] = -ours - 2
            self._new_definitions.append((ours, self._content(ours)))
        return code

    def ours(self, code: int) -> int:
        return code if code >= DEAD else self._ours[-code - 2]

    def definitions(self) -> Definitions:
        definitions, self._new_definitions = self._new_definitions, []
        return definitions

    def learn(self, definitions: Definitions) -> None:
        for theirs, content in definitions:
            ours = self._ours[theirs] = self._adopt(content)
            self._codes.setdefault(ours, theirs)


class _StateTranslator:
    """A converter of state numbers at one end of the connection between two processes."""

    def __init__(self, swarm: ModelSwarm) -> None:
        local, zones = swarm.local, swarm.zones
        self._swarm = swarm
        self._locals = _NumberTranslator(len(local.known), local.content, local.adopt)
        self._zones = _NumberTranslator(len(zones), zones.matrix, zones.adopt)
        self._completed = len(local.blocks.completed)

    def encode(self, states: Sequence[State]) -> StateBatch:
        flat = array("q")
        for state in states:
            flat.extend(state[:ZONE])
            flat.append(self._zones.code(state[ZONE]))
            flat.extend(map(self._locals.code, state[AGENTS:]))
        completed = self._swarm.local.blocks.completed[self._completed :]
        self._completed += len(completed)
        return StateBatch(self._locals.definitions(), self._zones.definitions(), completed, flat)

    def decode(self, batch: StateBatch) -> list[State]:
        """Return the received states with the numbers of this process."""
        self._swarm.local.blocks.note_completed(batch.completed)
        self._completed = len(self._swarm.local.blocks.completed)
        self._locals.learn(batch.locals)
        self._zones.learn(batch.zones)
        flat, size = batch.states, AGENTS + self._swarm.bounds.agents
        return [
            (
                *flat[at : at + ZONE],
                self._zones.ours(flat[at + ZONE]),
                *map(self._locals.ours, flat[at + AGENTS : at + size]),
            )
            for at in range(0, len(flat), size)
        ]


class _WorkerFunction:
    """The function that a worker process runs. For the states in a task, it computes the successors, or the number of
    further votes until all chains are equal.
    """

    def __init__(self, swarm: ModelSwarm) -> None:
        self._swarm = swarm
        self._translator = _StateTranslator(swarm)
        self._reported: dict[State, int] = {}
        self._next_number = count()
        self._votes = ExtraVotes(swarm)

    def __call__(self, task: StateBatch | ForkedStates) -> WorkerAnswer:
        answer = self._needed(task) if isinstance(task, ForkedStates) else self._following(task)
        return WorkerAnswer(answer, memory_bytes(), time.process_time(), self._swarm.local.steps)

    def _following(self, task: StateBatch) -> SuccessorBatch:
        fresh: list[State] = []
        if len(self._reported) >= MAX_REPORTED:
            self._reported.clear()

        def number_of(state: State) -> int:
            number = self._reported.get(state)
            if number is None:
                number = self._reported[state] = next(self._next_number)
                fresh.append(state)
            return number

        expansions = []
        for state in self._translator.decode(task):
            known = len(fresh)
            expansion = expanded(self._swarm, state, number_of)
            expansions.append((len(fresh) - known, expansion))
        return SuccessorBatch(self._translator.encode(fresh), expansions)

    def _needed(self, task: ForkedStates) -> NeededVotes:
        self._reported.clear()  # there are no further tasks for successors
        try:
            return NeededVotes([self._votes.needed(fork) for fork in self._translator.decode(task.batch)])
        except UndecidedError:
            return NeededVotes(None)


class _WorkerHandle:
    """The main process's view of a worker process."""

    def __init__(self, swarm: ModelSwarm) -> None:
        self.memory_bytes = 0.0
        self.processor_s = 0.0
        self.steps = 0
        self._steps_at_fork = swarm.local.steps
        self._translator = _StateTranslator(swarm)
        self._worker: WorkerProcess[StateBatch | ForkedStates, WorkerAnswer] = WorkerProcess(_WorkerFunction(swarm))
        self._numbers: list[int] = []
        """The states that the worker has sent, as numbers of the main process, in the order in which they were sent."""

    @property
    def connection(self) -> Connection:
        return self._worker.connection

    def give(self, states: Sequence[State]) -> None:
        self._worker.connection.send(self._translator.encode(states))

    def give_forks(self, states: Sequence[State]) -> None:
        self._worker.connection.send(ForkedStates(self._translator.encode(states)))

    def receive(self) -> SuccessorBatch | NeededVotes:
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
        assert isinstance(answer, WorkerAnswer)
        self.memory_bytes = answer.memory_bytes
        self.processor_s = answer.processor_s
        self.steps = answer.steps - self._steps_at_fork
        return answer.answer

    def expansions_of(
        self, answer: SuccessorBatch, first: int, add: Callable[[State, int], int]
    ) -> Iterator[StateExpansion]:
        """Yield the successors of each state in a worker's answer. The first state has the number `first`. `add` stores
        new states in the graph.
        """
        fresh = iter(self._translator.decode(answer.batch))
        numbers = self._numbers
        for parent, (new, expansion) in enumerate(answer.expansions, first):
            for _ in range(new):
                numbers.append(add(next(fresh), parent))
            yield StateExpansion(
                expansion.transitions,
                tuple(tuple(numbers[reported] for reported in after) for after in expansion.by_timer),
                tuple(numbers[reported] for reported in expansion.crossing),
            )

    def stop(self) -> None:
        self._worker.stop()


Give = Callable[["_WorkerHandle", Sequence[State]], None]


class Workers:
    """A pool of `size` worker processes. They start with the first task and stop at the end of the context."""

    def __init__(self, swarm: ModelSwarm, size: int) -> None:
        self._swarm = swarm
        self._size = size
        self._handles: list[_WorkerHandle] = []

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        for other in self._handles:
            other.stop()

    @property
    def memory_bytes(self) -> float:
        return sum(other.memory_bytes for other in self._handles)

    @property
    def processor_s(self) -> float:
        return sum(other.processor_s for other in self._handles)

    @property
    def steps(self) -> int:
        """The number of agent steps that all workers have computed."""
        return sum(other.steps for other in self._handles)

    def pays_off(self, waiting: int) -> bool:
        """Return true if the number of waiting states is so large that the workers save time."""
        return self._size > 1 and waiting >= WORTH_WORKERS

    def expansions(
        self, states: Sequence[State], first: int, add: Callable[[State, int], int], check: Check = lambda: None
    ) -> Iterator[StateExpansion]:
        """Yield the successors of each state in order. The first state has the number `first`. `states` may grow during
        the loop.
        """
        for other, number, answer in self._answers(_WorkerHandle.give, states, check, first):
            assert isinstance(answer, SuccessorBatch)
            yield from other.expansions_of(answer, number, add)

    def needed(self, forks: Sequence[State], check: Check) -> Iterator[int | PropertyViolation | None]:
        """Yield a result for each state: the number of further votes until all chains are equal. If one vote per agent
        is not enough, the result is the violation that ended a path, or None. Raises UndecidedError if a worker reaches
        its limit of states.
        """
        for _, _, answer in self._answers(_WorkerHandle.give_forks, forks, check):
            assert isinstance(answer, NeededVotes)
            if answer.votes is None:
                raise UndecidedError
            yield from answer.votes

    def _answers(
        self, give: Give, states: Sequence[State], check: Check, first: int = 0
    ) -> Iterator[tuple[_WorkerHandle, int, SuccessorBatch | NeededVotes]]:
        """Yield the answers of the workers in the order of the tasks, each with its worker and with the number of the
        first state of its task. `states` may grow during the loop.
        """
        if not self._handles:
            with signals_blocked():  # a Ctrl-C inside a fork must not end it halfway
                self._handles = [_WorkerHandle(self._swarm) for _ in range(self._size)]
        idle = deque(self._handles)
        busy: dict[int, _WorkerHandle] = {}
        answers: dict[int, tuple[_WorkerHandle, SuccessorBatch | NeededVotes]] = {}
        due: deque[int] = deque()
        given = first
        while True:
            while idle and given < len(states):
                size = min(CHUNK, max(1, (len(states) - given) // (2 * len(self._handles))))
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
            if due[0] in answers and not (idle and given < len(states)):  # first give tasks to all idle workers
                number = due.popleft()
                other, answer = answers.pop(number)
                yield other, number, answer


def _answered(busy: Mapping[int, _WorkerHandle], *, wait_for_one: bool) -> list[int]:
    """Return the finished tasks. Each task is identified by the number of its first state. Return an empty list if no
    task finishes within WAIT_S seconds.
    """
    ready = wait([other.connection for other in busy.values()], timeout=WAIT_S if wait_for_one else 0)
    return [number for number, other in busy.items() if other.connection in ready]
