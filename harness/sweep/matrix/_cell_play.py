"""Play one run of a matrix, either as a simulation or with real programs in its own run directory."""

import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from harness.archive.archive import RunArchive
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
from harness.sweep.matrix._run_steps import fingerprint


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
    """True if the coverage of each run is measured. `judge` is then not called for simulated runs."""
    is_cancelled: Callable[[], bool] | None = None
    """A function that returns true if a run with real programs must end early. A run in a thread needs it, because only
    the main thread receives signals.
    """

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
            finished = run(
                scenario, task.seed, directory, SilentProgress(), task.point.backend, is_cancelled=self.is_cancelled
            )
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
