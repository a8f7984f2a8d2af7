"""Play one run of a matrix, either as a simulation or with real programs in its own run directory.

Fingerprints show the first handler run at which a run differs from the same run of an earlier night. The fingerprint of
a run has two bytes for each handler run, in the order of mission time. The first two bytes that differ between two
nights give the position of the first changed handler run. To find its name, the run is played again with the current
code. The code of the earlier night is therefore not needed.

Handler runs that only received a message are omitted. If the agent core is edited, the simulation delivers more
messages that have no effect. The handler runs of these messages would hide the first real change.
"""

import base64
import shutil
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from pydantic import BaseModel

from harness.archive.archive import RunArchive
from harness.archive.traces import Trace, only_receives
from harness.checker import Result, gather
from harness.checker.steps import first_cause
from harness.errors import VIOLATED, HarnessError, InterruptedRunError, UnsupportedError
from harness.gc_pause import gc_paused
from harness.play.backends import BACKENDS
from harness.play.mission import RunOutcome
from harness.play.progress import SilentProgress
from harness.proof.coverage import CoverageWatcher, ReachedStates, reached_in
from harness.proof.coverage.reached import simulate_watched
from harness.run.run import run
from harness.scenario import Scenario
from harness.sweep.matrix._cell import Run
from harness.sweep.matrix._estimate import growth_figures
from harness.sweep.matrix._matrix_file import Matrix, MatrixPoint, MatrixTask
from ucp.trace import HandlerRun

MAX_STEPS = 4000
"""Maximum number of handler runs in a fingerprint."""
_BYTES = 2


class HandlerStep(NamedTuple):
    """A handler run, with the ID of the agent that ran the handler."""

    t: float
    agent_id: int
    run: HandlerRun


class FirstChange(BaseModel):
    """The first handler run at which the run with this seed differs from the same run of the earlier night.

    `handler` is null in two cases: the fingerprint does not include this handler run, or the new run ended before it.
    """

    seed: int
    at_s: float | None = None
    agent_id: int | None = None
    handler: str | None = None
    branch: str | None = None


def fingerprint(traces: Mapping[int, Trace]) -> str:
    """Return the fingerprint of a run in base64. The result is empty without traces."""
    digests = [_digest(step).to_bytes(_BYTES) for step in _steps(traces)[:MAX_STEPS]]
    return base64.b64encode(b"".join(digests)).decode("ascii")


def first_changed(before: str, now: str) -> int | None:
    """Return the position of the first handler run that differs between the two fingerprints. Return None if the
    fingerprints are equal.
    """
    if before == now:
        return None
    was, is_now = base64.b64decode(before), base64.b64decode(now)
    shared = min(len(was), len(is_now))
    byte = next((place for place in range(shared) if was[place] != is_now[place]), shared)
    return byte // _BYTES


def name_change(scenario: Scenario, seed: int, position: int) -> FirstChange:
    """Play the run again, and return the handler run at this position."""
    from harness.run.simulate import simulate

    steps = _steps(simulate(scenario, seed, tracing=True).evidence.traces)
    if position >= len(steps):
        return FirstChange(seed=seed)
    step = steps[position]
    return FirstChange(
        seed=seed, at_s=round(step.t, 3), agent_id=step.agent_id, handler=step.run.handler, branch=step.run.branch
    )


def _steps(traces: Mapping[int, Trace]) -> list[HandlerStep]:
    """Return the handler runs that had an effect, of all agents, in the order of mission time."""
    steps = [
        HandlerStep(run.t, agent_id, run)
        for agent_id, trace in sorted(traces.items())
        for run in trace.runs
        if run.sent or not only_receives(run)
    ]
    return sorted(steps, key=attrgetter("t"))


def _digest(step: HandlerStep) -> int:
    run = step.run
    sent = [(message.message, message.seq, message.block) for message in run.sent]
    facts = (round(step.t, 6), step.agent_id, run.handler, run.branch, [*map(tuple, run.changes)], sent)
    return zlib.crc32(repr(facts).encode()) % (1 << 8 * _BYTES)


class JudgedRun(NamedTuple):
    """A run with its verdicts. `steps` is the fingerprint of the run's handler runs. It is empty if there are no
    traces.
    """

    played: RunOutcome
    result: Result
    steps: str = ""


Judge = Callable[[Scenario, int], JudgedRun]
"""A function that runs a scenario with a seed, and judges the run."""


class RunFailedError(HarnessError):
    """An error: a run was not completed, or one of its agents crashed or hung."""

    exit_status = VIOLATED


@gc_paused()
def simulated(scenario: Scenario, seed: int, *, tracing: bool = True) -> JudgedRun:
    """Simulate a run in virtual time, and judge the run. If `tracing` is true, also judge every step of the agents."""
    from harness.run.simulate import simulate

    run = simulate(scenario, seed, tracing=tracing)
    return JudgedRun(run.played, run.result, fingerprint(run.evidence.traces))


@gc_paused()
def play_with_coverage(scenario: Scenario, seed: int, reached: ReachedStates) -> JudgedRun:
    """Simulate a run with traces, and add its coverage to `reached`."""
    watcher = CoverageWatcher()
    run = simulate_watched(scenario, seed, watcher.step)
    reached.add(watcher.reached)
    return JudgedRun(run.played, run.result, fingerprint(run.evidence.traces))


def _same_twice(scenario: Scenario, seed: int) -> None:
    from harness.run.simulate import check_determinism

    check_determinism(scenario, seed)


@dataclass(frozen=True)
class RunPlayer:
    """A function that carries out any run of a matrix."""

    matrix: Matrix
    directory: Path
    """The directory in which runs with real programs store their run directories."""
    judge: Judge = simulated
    """The function that carries out and judges simulated runs."""
    covers: bool = False
    """True if the coverage of each run is measured. If it is true, `judge` is not used in virtual time."""

    def __call__(self, task: MatrixTask) -> Run:
        scenario = self.matrix.scenario_at(task.point)
        in_memory = BACKENDS[task.point.backend].plays_in_memory
        try:
            if in_memory and scenario.foreign and task.seed == self.matrix.seed_list[0]:
                _same_twice(scenario, task.seed)
            reached = ReachedStates() if self.covers else None
            if not in_memory:
                judged = self._play_with_processes(scenario, task, reached)
            elif reached is not None:
                judged = play_with_coverage(scenario, task.seed, reached)
            else:
                judged = self.judge(scenario, task.seed)
        except UnsupportedError as error:
            return Run(**task.point._asdict(), seed=task.seed, unsupported=str(error))
        verdicts = {key: judgement.verdict for key, judgement in judged.result.judgements.items()}
        figures = dict(judged.result.figures)
        if self.matrix.grows:
            figures |= growth_figures(scenario, judged.played.mission_s, figures)
        return Run(
            **task.point._asdict(),
            seed=task.seed,
            figures=figures,
            verdicts=verdicts,
            deviates_in=first_cause(judged.result.beside.get("steps")),
            steps=judged.steps,
            reached=reached,
        )

    def refuse(self, points: Iterable[MatrixPoint]) -> None:
        """Before the first run, check for each combination of values that it can be run. Raises HarnessError if a
        backend or this machine cannot run a combination.
        """
        for point in points:
            BACKENDS[point.backend].refuse(self.matrix.scenario_at(point))

    def _play_with_processes(self, scenario: Scenario, task: MatrixTask, reached: ReachedStates | None) -> JudgedRun:
        """Carry out a run with real programs. Raises UnsupportedError, or RunFailedError. The message of RunFailedError
        names the run directory.
        """
        directory = self.directory / directory_name(task)
        shutil.rmtree(directory, ignore_errors=True)  # remains of an interrupted run
        try:
            finished = run(scenario, task.seed, directory, SilentProgress(), task.point.backend)
        except HarnessError as error:  # errors that every run would have were found by `refuse`
            raise RunFailedError(f"{error}; see {directory}") from None
        if finished.played.outcome == "interrupted":
            raise InterruptedRunError(f"the run in {directory} was interrupted")
        if finished.played.outcome == "not supported":
            raise UnsupportedError(finished.played.outcome_detail)
        if finished.played.outcome == "failed":
            raise RunFailedError(f"{finished.played.outcome_detail}; see {directory}")
        if reached is not None:
            reached.add(reached_in(gather(RunArchive(directory))))
        if not finished.result.bad and self.matrix.keep == "violated":
            shutil.rmtree(directory)
        return JudgedRun(finished.played, finished.result)


def directory_name(task: MatrixTask) -> str:
    return f"{task.point.file_name}-{task.point.backend}-seed-{task.seed}"
