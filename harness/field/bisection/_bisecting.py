"""The first commit at which the outcome changes."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from harness.errors import RunDirectoryError
from harness.field.bisection._playing import CannotBeTriedError, Workshop
from harness.field.bisection.outcome import Outcome, differences
from harness.report.difference import Difference, compare
from harness.run.code_state import Commit, History, Narrowed, RepositoryError


@dataclass(frozen=True)
class Tried:
    """What trying a commit came to: as it was, changed, or it cannot be tried; `why` says in what, or why not."""

    commit: str
    verdict: Literal["good", "bad", "skip"]
    why: str


@dataclass
class Found:
    """`first` is the commit at which the outcome changes; several if it is one of them and they cannot be tried.

    None of them if the outcome is the same at the good commit and at the bad one.
    """

    good: Outcome
    bad: Outcome
    first: list[Commit] = field(default_factory=list)
    tried: list[Tried] = field(default_factory=list)
    changes: list[str] = field(default_factory=list)
    """In what the outcome right after the change differs from that of the good commit."""
    parting: Difference | None = None
    """Where the runs part, of a scenario in virtual time."""

    def to_json(self) -> dict[str, Any]:
        return {
            "first": [{"hash": commit.hash, "subject": commit.subject, "files": commit.files} for commit in self.first],
            "changes": self.changes,
            "parting": self.parting.to_json() if self.parting else None,
            "tried": [{"commit": each.commit, "verdict": each.verdict, "why": each.why} for each in self.tried],
            "good": self.good.model_dump(mode="json"),
            "bad": self.bad.model_dump(mode="json"),
        }


def bisect(
    workshop: Workshop, repository: Path, good: str, bad: str, directory: Path, tell: Callable[[str], None]
) -> Found:
    """Try commits between the revisions `good` and `bad`; `directory` is for the clone and is emptied by nobody here.

    `tell` hears a line for each commit that was tried. Raises HarnessError.
    """
    history = History.clone(repository, directory / "code")
    good_commit, bad_commit = history.resolve(good), history.resolve(bad)
    if good_commit == bad_commit:
        raise RepositoryError(f"--good {good} and --bad {bad} are the same commit, {good_commit[:12]}")
    good_outcome, good_run = _surely(workshop, history, good_commit, "--good")
    tell(f"{good_commit[:12]} good: {good_outcome.sentence}")
    bad_outcome, bad_run = _surely(workshop, history, bad_commit, "--bad")
    found = Found(good_outcome, bad_outcome)
    runs = {bad_commit: (bad_outcome, bad_run)}
    changes = differences(good_outcome, bad_outcome)
    if not changes:
        return found
    tell(f"{bad_commit[:12]} bad: {changes[0]}; {history.between(good_commit, bad_commit)} commits to choose from")
    step = history.begin(good_commit, bad_commit)
    while not isinstance(step, Narrowed):
        tried = _try(workshop, history, step, good_outcome, runs)
        found.tried.append(tried)
        tell(f"{tried.commit[:12]} {tried.verdict}: {tried.why}")
        step = history.mark(tried.verdict)
    found.first = [history.commit(commit) for commit in step.first]
    outcome, run = runs.get(step.first[0] if len(step.first) == 1 else bad_commit, (bad_outcome, bad_run))
    found.changes = differences(good_outcome, outcome)
    found.parting = _parting(good_run, run) if workshop.plays_the_same else None
    return found


def _surely(workshop: Workshop, history: History, commit: str, option: str) -> tuple[Outcome, Path]:
    history.check_out(commit)
    try:
        return workshop.play(history.tree)
    except CannotBeTriedError as error:
        raise RepositoryError(
            f"{option} {commit[:12]} cannot be tried: {error}; name a commit that plays {workshop.subject.in_words}"
        ) from None


def _try(
    workshop: Workshop, history: History, commit: str, good: Outcome, runs: dict[str, tuple[Outcome, Path]]
) -> Tried:
    try:
        outcome, run = workshop.play(history.tree)
    except CannotBeTriedError as error:
        return Tried(commit, "skip", f"cannot be tried: {error}")
    changes = differences(good, outcome)
    if not changes:
        shutil.rmtree(run, ignore_errors=True)
        return Tried(commit, "good", "as it was")
    runs[commit] = (outcome, run)
    return Tried(commit, "bad", changes[0])


def _parting(good_run: Path, run: Path) -> Difference | None:
    try:
        return compare(good_run, run)
    except RunDirectoryError:  # one of them crashed, and left half a run
        return None
