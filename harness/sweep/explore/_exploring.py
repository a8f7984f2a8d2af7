"""Run a scenario with many seeds until a run violates a characteristic. Then record this run, reduce the scenario, and
write it to a file.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from harness.checker.judgement import Judgement
from harness.errors import INCOMPLETE, INTERRUPTED, VIOLATED
from harness.run.parallel import FailedTask, cores, sweep
from harness.run.simulate import Judge, check_determinism, choose_path, evidence_lines, simulated, write_new_file
from harness.scenario import Scenario
from harness.scenario.verdict_names import BAD_IN_WORDS
from harness.sweep.explore._recording import Recording, record
from harness.sweep.explore._scenario_document import Document, document_of
from harness.sweep.explore._smaller import BudgetSpentError, Shrinker, file_of, replays, scenario_of, shrink, size


@dataclass(frozen=True, slots=True)
class ViolatingRun:
    """A run with bad verdicts."""

    seed: int
    keys: tuple[str, ...]
    """The numbers or keys of the checks with a bad verdict."""


@dataclass
class SearchResult:
    """The result of a search for a violation."""

    played: int = 0
    violation: ViolatingRun | None = None
    failed: dict[int, str] = field(default_factory=dict)
    """Seed -> the reason why the run with this seed has no verdict."""
    unfinished: list[int] = field(default_factory=list)
    """The seeds of runs in which the swarm only needed more time."""
    interrupted: bool = False


def search(scenario: Scenario, seeds: range, jobs: int, judge: Judge, *, shown: bool = False) -> SearchResult:
    """Run the scenario with one seed after another until a run violates a check. A run in which the swarm only needed
    more time violates no check.

    The result contains the first of the `seeds` whose run violates a check, regardless of the number of `jobs`. Ctrl-C
    ends the search early. Raises HarnessError if the scenario cannot be played.
    """
    searched = SearchResult()

    def verdict(seed: int) -> tuple[tuple[str, ...], bool]:
        result = judge(scenario, seed)
        return result.wrong, result.exit_status == INCOMPLETE

    try:
        with sweep(seeds, verdict, jobs, what="seeds" if shown else None) as outcomes:
            for seed, outcome in outcomes:
                searched.played += 1
                if isinstance(outcome, FailedTask):
                    searched.failed[seed] = outcome.reason
                    continue
                wrong, needs_time = outcome
                if wrong:
                    searched.violation = ViolatingRun(seed, wrong)
                    break
                if needs_time:
                    searched.unfinished.append(seed)
    except KeyboardInterrupt:
        searched.interrupted = True
    return searched


MAX_RUNS = 5000
SEEDS = 1000
"""Default number of seeds with which the scenario is run."""


@dataclass(frozen=True)
class ShrunkScenario:
    """The smallest scenario found that still violates the check."""

    path: Path
    """The file of the scenario."""
    seed: int
    violated: dict[str, Judgement]
    words: str
    """A text that compares the size of the scenario before and after the reduction. The text also contains the number
    of runs that the reduction needed.
    """
    replay: str


@dataclass
class Explored:
    """The result of the command `explore`."""

    searched: SearchResult
    shrunk: ShrunkScenario | None = None
    """The smallest scenario found. None if no run violated a check."""
    interrupted: bool = False
    """True if Ctrl-C ended the search, or ended the attempts to make the scenario smaller."""

    @property
    def exit_status(self) -> int:
        if self.interrupted:
            return INTERRUPTED
        if self.searched.violation or self.searched.failed:
            return VIOLATED
        return INCOMPLETE if self.searched.unfinished else 0


@dataclass(frozen=True)
class SearchProgress:
    """Functions that show the progress to the user."""

    on_violation: Callable[[ViolatingRun], None] = field(default=lambda violation: None)
    on_step: Callable[[int, str], None] = field(default=lambda runs, words: None)
    """A function that receives the number of runs so far, and a text with the size of the current scenario."""
    shown: bool = False


def explore(
    scenario: Scenario,
    seeds: range = range(SEEDS),
    out: Path | None = None,
    *,
    source: str | None = None,
    jobs: int | None = None,
    judge: Judge = simulated,
    max_runs: int = MAX_RUNS,
    watcher: SearchProgress | None = None,
) -> Explored:
    """Play a scenario in virtual time with one seed after another. Reduce the first run that violates a check.

    - `out`: the path of the new file for the smallest scenario. By default, a new file under `runs/`.
    - `source`: the name by which comments in that file mention the original scenario. By default, its `name`.
    - `jobs`: number of runs at the same time. By default, the number of processor cores.
    - `judge`: plays and checks one run.
    - `max_runs`: number of runs after which shrinking stops.
    - `watcher`: functions that are called when a violation is found and when it becomes smaller.

    Raises HarnessError if the scenario cannot be played, the file cannot be written, or an agent behaves differently in
    two runs of the same seed.
    """
    watcher, jobs, source = watcher or SearchProgress(), jobs or cores(), source or scenario.name
    path = choose_path(out, scenario.name)
    if scenario.foreign:
        check_determinism(scenario, seeds[0])
    searched = search(scenario, seeds, jobs, judge, shown=watcher.shown)
    explored = Explored(searched, interrupted=searched.interrupted)
    if searched.violation is None:
        return explored
    seed, key = searched.violation.seed, searched.violation.keys[0]
    watcher.on_violation(searched.violation)

    def still(candidate: Scenario) -> bool:
        return key in judge(candidate, seed).wrong

    def recorded(document: Document) -> Recording:
        return record(scenario_of(document), seed)

    smallest, words, explored.interrupted = smallest_of(
        document_of(scenario), still, recorded, jobs=jobs, max_runs=max_runs, on_step=watcher.on_step
    )
    explored.shrunk = _written(smallest, path, source, seed, words, judge, recorded)
    return explored


def smallest_of(
    original: Document,
    still: Callable[[Scenario], bool],
    recorded: Callable[[Document], Recording],
    *,
    jobs: int,
    max_runs: int,
    on_step: Callable[[int, str], None],
) -> tuple[Document, str, bool]:
    """Remove parts of a scenario document, as long as `still` returns true for the smaller document. Return the
    smallest document found, a text about the steps of the reduction, and true if the user interrupted the search.
    """
    interrupted = False
    shrinker = Shrinker(
        original,
        still,
        jobs=jobs,
        max_runs=max_runs,
        adopted=lambda shrinker: on_step(shrinker.runs, size(shrinker.best)),
    )
    how = "and nothing more could be left out"
    first = size(original)
    try:
        shrinker.first(replays(original, recorded(original)))
        first = size(shrinker.best)
        shrink(shrinker, recorded)
    except BudgetSpentError:
        how = "when the bound was reached: it may not be the smallest"
    except KeyboardInterrupt:
        interrupted = True
        how = "when it was interrupted: it may not be the smallest"
    return shrinker.best, f"{first} -> {size(shrinker.best)} in {shrinker.runs} runs, {how}", interrupted


def _written(
    document: Document,
    path: Path,
    source: str,
    seed: int,
    words: str,
    judge: Judge,
    recorded: Callable[[Document], Recording],
) -> ShrunkScenario:
    result = judge(scenario_of(document), seed)
    judgements = {key: result.judgements[key] for key in result.wrong}
    replay = f"ucp-harness run {path} --backend sim --seed {seed}"
    header = [
        *evidence_lines(judgements),
        f"Shrunk from {source}, seed {seed}: {words}.",
        f"  {replay}",
    ]
    written = write_new_file(path, file_of(document, header, recorded(document)))
    return ShrunkScenario(written, seed, judgements, words, replay.replace(str(path), str(written)))


_MAX_SEEDS = 10
"""Maximum number of seeds that one sentence of the output lists."""
LINE_EVERY_S = 10.0
REDRAW_EVERY_S = 0.1
CLEAR_LINE = "\r\x1b[2K"


@contextlib.contextmanager
def watching(console: Console) -> Iterator[SearchProgress]:
    """Yield functions that print each violation, and the progress of the search for a smaller scenario.

    On a terminal, the progress is one line that changes. Other outputs get a line every ten seconds.
    """
    every_s = REDRAW_EVERY_S if console.is_terminal else LINE_EVERY_S
    last = 0.0

    def on_violation(violation: ViolatingRun) -> None:
        words = " and ".join(BAD_IN_WORDS[key] for key in violation.keys)
        console.print(f"seed {violation.seed}: {words}; shrinking", highlight=False)

    def on_step(runs: int, words: str) -> None:
        nonlocal last
        if time.monotonic() - last >= every_s:
            last = time.monotonic()
            so_far = f"{words} after {runs} {'run' if runs == 1 else 'runs'}"
            if console.is_terminal:
                console.file.write(f"{CLEAR_LINE}{so_far}"[: console.width + len(CLEAR_LINE)])
                console.file.flush()
            else:
                console.print(so_far, highlight=False, soft_wrap=True)

    try:
        yield SearchProgress(on_violation, on_step, shown=True)
    finally:
        if console.is_terminal:
            console.file.write(CLEAR_LINE)


def in_words(explored: Explored) -> Iterator[str]:
    played = explored.searched.played
    yield f"{played} seed{'' if played == 1 else 's'} played" + (
        "" if explored.searched.violation else ": no characteristic is violated"
    )
    if seeds := explored.searched.unfinished:
        listed = ", ".join(map(str, seeds[:_MAX_SEEDS])) + (", ..." if len(seeds) > _MAX_SEEDS else "")
        yield f"not finished: {len(seeds)} of them need a longer mission to be judged, seeds {listed}"
    if explored.shrunk:
        yield from evidence_lines(explored.shrunk.violated)
        yield explored.shrunk.words
        yield str(explored.shrunk.path)
        yield explored.shrunk.replay
