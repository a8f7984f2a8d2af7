"""Find the commits that made a numeric result worse. The search plays the same run with different commits of the code.
These commits were made between the earlier night and this night.

A run in virtual time is always the same, so one run is enough. The search uses the run whose result became worse by the
largest amount. A binary search finds the first commit with a different result. If a later commit changed the result
again, the search continues after the found commit. The search therefore also finds commits that change the result
without making it worse. For each found commit, the output contains the result before and after the commit.
"""

import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.archive.archive import RunArchive
from harness.errors import HarnessError
from harness.field.bisection import BisectionSubject, SubjectPlayer, UntestableError
from harness.run.code_state import GitBisection, SuspectCommits
from harness.run.provenance import MODIFIED, ROOT
from harness.sweep.matrix._comparison import Change, Culprit, CulpritCommit
from harness.sweep.matrix._estimate import BY_NAME, Metric
from harness.sweep.matrix.matrix_record import MatrixRecord

LIMIT_S = 600.0
"""Maximum number of seconds for one run at one commit."""


class _TimeIsUpError(Exception):
    """An error: the time limit for the search has passed."""


def find_culprits(
    tonight: MatrixRecord, baseline: MatrixRecord, budget_s: float, report_progress: Callable[[str], None]
) -> list[Culprit]:
    """Search for the commits that made numeric results worse, until the time budget is used up.

    The search considers each cell with simulated runs whose result became worse. It uses the code repository from which
    the harness runs. Ctrl-C ends the search.
    """
    regressions = {change.point: change for change in reversed(_paired_regressions(tonight))}
    deadline, culprits = time.monotonic() + budget_s, []
    for change in regressions.values():
        culprit = Culprit(**change.point._asdict(), metric=change.metric, seed=_worst_seed(tonight, baseline, change))
        try:
            with TemporaryDirectory(prefix="ucp-harness-culprits-") as directory:
                search = _CulpritSearch(tonight, baseline, culprit, Path(directory), deadline, report_progress)
                search.run()
        except _TimeIsUpError:
            culprit = culprit.model_copy(update={"problem": "the time for the search was used up"})
        except KeyboardInterrupt:
            culprit = culprit.model_copy(update={"problem": "the search was interrupted"})
            deadline = time.monotonic()
        except HarnessError as error:
            culprit = culprit.model_copy(update={"problem": str(error)})
        culprits.append(culprit)
    return culprits


def _paired_regressions(record: MatrixRecord) -> list[Change]:
    return [change for change in record.against.regressions if change.difference is not None] if record.against else []


def _worst_seed(tonight: MatrixRecord, baseline: MatrixRecord, change: Change) -> int:
    """Return the seed of the run in which the numeric result became worse by the largest amount."""
    metric = BY_NAME[change.metric]
    sign = 1 if metric.worse == "higher" else -1
    before = {run.seed: metric.of(run.figures) for run in baseline.results if run.point == change.point}
    by_seed = {run.seed: metric.of(run.figures) for run in tonight.results if run.point == change.point}
    return max(by_seed, key=lambda seed: sign * ((by_seed[seed] or 0.0) - (before.get(seed) or 0.0)))


class _CulpritSearch:
    """A search for the commits that changed one run. The search adds these commits to the list in `culprit`."""

    def __init__(
        self,
        tonight: MatrixRecord,
        baseline: MatrixRecord,
        culprit: Culprit,
        directory: Path,
        deadline: float,
        report_progress: Callable[[str], None],
    ) -> None:
        self._ends = [record.versions.get("commit", "") for record in (baseline, tonight)]
        if not all(self._ends) or any(commit.endswith(MODIFIED) for commit in self._ends):
            raise HarnessError("the baseline or tonight's code is not a commit of a repository, so no commit is named")
        self._culprit, self._deadline, self._report_progress = culprit, deadline, report_progress
        self._metric: Metric = BY_NAME[culprit.metric]
        self._history = GitBisection.clone(ROOT, directory / "code")
        plays = directory / "plays"
        plays.mkdir()
        subject = BisectionSubject(plays, tonight.matrix.scenario_at(culprit.point), culprit.seed)
        self._workshop = SubjectPlayer(subject, plays, limit_s=LIMIT_S)
        self._figures: dict[str, float | None] = {}

    def run(self) -> None:
        good, bad = map(self._history.resolve, self._ends)
        while (at_good := self._figure(good)) != (at_bad := self._figure(bad)):
            found = self._first_after(good, bad, at_good)
            commit, after = self._history.commit(found), self._figure(found)
            fields = {"hash": commit.hash, "date": commit.date, "author": commit.author, "subject": commit.subject}
            self._culprit.commits.append(CulpritCommit(**fields, before=at_good, after=after))
            if after == at_bad:
                return
            good = found
        if not self._culprit.commits:
            raise HarnessError("the run has the same figure at both commits, so no commit is named")

    def _first_after(self, good: str, bad: str, figure: float | None) -> str:
        """Return the first commit after `good` whose run has another numeric result than `figure`."""
        step = self._history.begin(good, bad)
        while not isinstance(step, SuspectCommits):
            try:
                same = self._figure(step) == figure
            except UntestableError:
                step = self._history.mark("skip")
            else:
                step = self._history.mark("good" if same else "bad")
        if len(step.first) > 1:
            raise HarnessError(f"it is one of {len(step.first)} commits, most of which cannot be played")
        return step.first[0]

    def _figure(self, commit: str) -> float | None:
        """Return the numeric result that the run has with the code of this commit. Return None if the result is
        unknown. Raises UntestableError if an agent crashes.
        """
        if commit not in self._figures:
            if time.monotonic() > self._deadline:
                raise _TimeIsUpError
            self._history.check_out(commit)
            outcome, directory = self._workshop.play(self._history.tree)
            if outcome.crashed is not None:
                raise UntestableError(f"{commit[:12]} crashes: {outcome.crashed}")
            self._figures[commit] = self._metric.of(RunArchive(directory).record.figures)
            self._report_progress(f"{commit[:12]}: {self._metric.label} {self._figures[commit]}")
        return self._figures[commit]
