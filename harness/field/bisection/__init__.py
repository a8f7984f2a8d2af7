"""Find the commit that changed the behaviour of the agents.

The package runs a scenario, or replays a run or the records of a flight, with the code of several commits, and compares
the results. It can also compare two agent programs in this way. The module `outcome` calls the scenario, run or records
the *subject* of the search. `harness.run.code_state` checks out a commit in a separate clone, and runs processes with
it. `_playing` runs or replays the subject with this commit and returns the outcome. `bisect` searches the history of a
repository for the first commit with a different outcome. Records are replayed either by the core of another commit in a
separate process (`_record_core`), or by another agent program over UDP with scripted peers (`_live_replay`,
`_scripted_peers`).
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from harness.errors import RunDirectoryError
from harness.field.bisection._playing import SubjectPlayer, UntestableError
from harness.field.bisection.outcome import BisectionSubject, Outcome, differences, subject_of
from harness.report.difference import RunDifference, compare
from harness.run.code_state import GitBisection, GitCommit, RepositoryError, SuspectCommits

__all__ = [
    "BisectionResult",
    "BisectionSubject",
    "Outcome",
    "SubjectPlayer",
    "UntestableError",
    "bisect",
    "differences",
    "subject_of",
]


@dataclass(frozen=True)
class CommitTrial:
    """The result of testing one commit. `good` means that the outcome did not change. `bad` means that it changed.
    `skip` means that the commit cannot be tested, for the reason `why`.
    """

    commit: str
    verdict: Literal["good", "bad", "skip"]
    why: str


@dataclass
class BisectionResult:
    """The result of a bisection, the search for the first commit that changes the outcome."""

    good: Outcome
    bad: Outcome
    first: list[GitCommit] = field(default_factory=list)
    """The first commit that changes the outcome. If some commits cannot be tested, there are several candidates. There
    is no such commit if the good and the bad commit have the same outcome.
    """
    tried: list[CommitTrial] = field(default_factory=list)
    changes: list[str] = field(default_factory=list)
    """Differences between the outcome of the good commit and the outcome after the change."""
    first_difference: RunDifference | None = None
    """The first difference between the runs before and after the change. Only for a scenario in virtual time."""

    def to_json(self) -> dict[str, object]:
        return {
            "first": [{"hash": commit.hash, "subject": commit.subject, "files": commit.files} for commit in self.first],
            "changes": self.changes,
            "parting": self.first_difference.to_json() if self.first_difference else None,
            "tried": [{"commit": each.commit, "verdict": each.verdict, "why": each.why} for each in self.tried],
            "good": self.good.model_dump(mode="json"),
            "bad": self.bad.model_dump(mode="json"),
        }


def bisect(
    workshop: SubjectPlayer,
    repository: Path,
    good: str,
    bad: str,
    directory: Path,
    report_progress: Callable[[str], None],
) -> BisectionResult:
    """Search for the first commit with a changed outcome between `good` and `bad`. The repository is cloned into
    `directory`, which the caller must remove.

    `report_progress` receives a line for each commit. Raises HarnessError.
    """
    history = GitBisection.clone(repository, directory / "code")
    good_commit, bad_commit = history.resolve(good), history.resolve(bad)
    if good_commit == bad_commit:
        raise RepositoryError(f"--good {good} and --bad {bad} are the same commit, {good_commit[:12]}")
    good_outcome, good_run = _play_required(workshop, history, good_commit, "--good")
    report_progress(f"{good_commit[:12]} good: {good_outcome.sentence}")
    bad_outcome, bad_run = _play_required(workshop, history, bad_commit, "--bad")
    result = BisectionResult(good_outcome, bad_outcome)
    runs = {bad_commit: (bad_outcome, bad_run)}
    changes = differences(good_outcome, bad_outcome)
    if not changes:
        return result
    report_progress(
        f"{bad_commit[:12]} bad: {changes[0]}; {history.between(good_commit, bad_commit)} commits to choose from"
    )
    step = history.begin(good_commit, bad_commit)
    while not isinstance(step, SuspectCommits):
        tried = _try_commit(workshop, history, step, good_outcome, runs)
        result.tried.append(tried)
        report_progress(f"{tried.commit[:12]} {tried.verdict}: {tried.why}")
        step = history.mark(tried.verdict)
    result.first = [history.commit(commit) for commit in step.first]
    outcome, run = runs.get(step.first[0] if len(step.first) == 1 else bad_commit, (bad_outcome, bad_run))
    result.changes = differences(good_outcome, outcome)
    result.first_difference = _first_difference(good_run, run) if workshop.is_deterministic else None
    return result


def _play_required(workshop: SubjectPlayer, history: GitBisection, commit: str, option: str) -> tuple[Outcome, Path]:
    history.check_out(commit)
    try:
        return workshop.play(history.tree)
    except UntestableError as error:
        raise RepositoryError(
            f"{option} {commit[:12]} cannot be tried: {error}; name a commit that plays {workshop.subject.in_words}"
        ) from None


def _try_commit(
    workshop: SubjectPlayer, history: GitBisection, commit: str, good: Outcome, runs: dict[str, tuple[Outcome, Path]]
) -> CommitTrial:
    try:
        outcome, run = workshop.play(history.tree)
    except UntestableError as error:
        return CommitTrial(commit, "skip", f"cannot be tried: {error}")
    changes = differences(good, outcome)
    if not changes:
        shutil.rmtree(run, ignore_errors=True)
        return CommitTrial(commit, "good", "as it was")
    runs[commit] = (outcome, run)
    return CommitTrial(commit, "bad", changes[0])


def _first_difference(good_run: Path, run: Path) -> RunDifference | None:
    try:
        return compare(good_run, run)
    except RunDirectoryError:  # One of the runs crashed and is incomplete.
        return None
