"""Test the causes of a changed night: the first changed handler run of each changed run, and the commits that made a
figure worse.
"""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from harness.field.bisection import Outcome, UntestableError
from harness.scenario import Scenario
from harness.sweep.matrix import Finished, MatrixRecord, _culprits, matrix_outputs, run_matrix
from harness.sweep.matrix._culprits import find_culprits
from harness.sweep.matrix._run_steps import fingerprint, first_changed, name_change
from harness.sweep.matrix.matrix_run import compare_with, name_changes, on_cores
from harness.sweep.matrix.matrix_table import changed_runs, troubles
from harness.sweep.matrix.nights import BaselineNight, StoredNights
from harness.sweep.matrix.report import to_html
from tests.harness.command import harness
from tests.harness.sweep.matrix.stub import judge, matrix, played
from tests.harness.sweep.matrix.test_comparison import busier
from tests.harness.virtual import scenario

SMALL = {"duration_s": 100, "events": {"source": "random", "mean_s": 5}, "vehicles": {"kind": "none"}}


def test_position_of_the_first_difference_is_that_of_the_step() -> None:
    equal, other, longer = "AAECAwQF", "AAECBwQF", "AAECAwQFBgc="  # 6, 6 and 8 bytes: 3, 3 and 4 steps
    assert first_changed(equal, equal) is None
    assert first_changed(equal, other) == 1
    assert first_changed(equal, longer) == first_changed(longer, equal) == 3
    assert first_changed("", equal) == 0


def steps(**keys: Any) -> tuple[Scenario, str]:
    from harness.run.simulate import simulate

    asked = scenario(agents=3, **SMALL, **keys)
    return asked, fingerprint(simulate(asked, 1, tracing=True).evidence.traces)


def test_first_changed_handler_run_is_the_one_with_the_new_setting() -> None:
    _, before = steps()
    asked, now = steps(timeline=[{"at_s": 50, "reconcile": [2]}])
    position = first_changed(before, now)
    assert position is not None
    change = name_change(asked, 1, position)
    assert (change.at_s, change.agent_id, change.handler) == (50.0, 2, "reconcile_begin")
    assert name_change(asked, 1, 10**6).handler is None


def test_changed_runs_list_their_first_changed_handler_runs(tmp_path: Path) -> None:
    """A later night has different code. This test changes the scenario instead, because it can use only one version of
    the code.
    """

    def night(name: str, **keys: Any) -> Finished:
        asked = matrix(loss=(0.0,), seeds=3, agents=[3], scenario=SMALL | keys)
        return run_matrix(asked, tmp_path / name, on_cores(asked, 1))

    before, now = night("before"), night("now", timeline=[{"at_s": 50, "reconcile": [2]}])
    baseline = BaselineNight(Path("x"), before.record, frozenset(now.record.matrix.points), [])
    finished = name_changes(compare_with(now, baseline), baseline, 1)
    assert finished.record.against is not None
    (changed,) = finished.record.against.changed_runs
    assert changed.seeds == [1, 2, 3]
    assert [(each.seed, each.at_s, each.handler) for each in changed.first] == [
        (seed, 50.0, "reconcile_begin") for seed in (1, 2, 3)
    ]
    (sentence,) = changed_runs(finished.record)
    assert sentence.endswith("they differ first in reconcile_begin (3), the earliest of seed 1 at 50.0 s, agent 2")
    page = to_html(finished, tmp_path)
    assert page.count('<td class="text">reconcile_begin</td>') == 3
    assert "ucp-harness bisect cells/loss-0.0-agents-3.yaml --seed 1 --good " in page


FIGURES = {"a": 20, "b": 20, "c": 22, "d": None, "e": 50, "f": 50}
"""The number of reconciles of the run at each commit, by the commit's subject. None means that the commit cannot
run.
"""


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Create a repository whose code is a number. To play a run, the test reads this number. Return each commit by its
    subject.
    """
    path, commits = tmp_path / "repository", {}
    path.mkdir()

    def git(*arguments: str) -> str:
        who = ["-c", "user.name=Ann", "-c", "user.email=a@b"]
        return subprocess.run(["git", *who, *arguments], cwd=path, capture_output=True, text=True, check=True).stdout

    git("init", "--quiet")
    for subject, figure in FIGURES.items():
        (path / "figure").write_text(f"{json.dumps(figure)}\n{subject}")
        git("add", "--all")
        git("commit", "--quiet", "--message", subject)
        commits[subject] = git("rev-parse", "HEAD").strip()

    def play(workshop: Any, code: Path) -> tuple[Outcome, Path]:
        figure = json.loads((code / "figure").read_text().splitlines()[0])
        if figure is None:
            raise UntestableError("it does not start")
        run = tmp_path / f"run-{figure}"
        run.mkdir(exist_ok=True)
        (run / "run.json").write_text(json.dumps({"schema": "ucp-run/1", "figures": {"reconciles": figure}}))
        return Outcome(subject="a run"), run

    monkeypatch.setattr(_culprits, "ROOT", path)
    monkeypatch.setattr(_culprits.SubjectPlayer, "play", play)
    return commits


def night(finished: Finished, commit: str) -> MatrixRecord:
    return finished.record.model_copy(update={"versions": {"commit": commit}})


def regression(good: str, bad: str) -> tuple[MatrixRecord, MatrixRecord]:
    """Return the record of a night with a worse figure, and its baseline. The two nights have these commits."""
    asked = matrix(seeds=[1, 3, 4])
    baseline = night(played(asked, 1, judge), good)
    now = played(asked, 1, busier)
    compared = compare_with(now, BaselineNight(Path("x"), baseline, frozenset(asked.points), []))
    return night(compared, bad), baseline


def silent(step: str) -> None:
    pass


def test_search_names_each_commit_that_changes_the_figure(repository: dict[str, str]) -> None:
    tonight, baseline = regression(repository["a"], repository["f"])
    (culprit,) = find_culprits(tonight, baseline, 900, silent)
    assert (culprit.metric, culprit.seed) == ("reconciles", 1)
    assert [(commit.subject, commit.before, commit.after) for commit in culprit.commits] == [("c", 20, 22)]
    assert culprit.problem == "it is one of 2 commits, most of which cannot be played"
    assert tonight.against is not None
    record = tonight.model_copy(update={"against": tonight.against.model_copy(update={"culprits": [culprit]})})
    lines = [line for cell in record.cells for line in troubles(record, cell)]
    assert any(f"becomes 22, was 20, at {repository['c'][:12]}" in line and "Ann: c" in line for line in lines)


def test_search_ends_at_its_budget_and_without_commits(repository: dict[str, str]) -> None:
    (late,) = find_culprits(*regression(repository["a"], repository["c"]), 0, silent)
    assert (late.commits, late.problem) == ([], "the time for the search was used up")
    (edited,) = find_culprits(*regression(repository["a"], f"{repository['c']}-dirty"), 900, silent)
    assert edited.problem is not None
    assert "is not a commit of a repository" in edited.problem
    (same,) = find_culprits(*regression(repository["e"], repository["f"]), 900, silent)
    assert same.problem == "the run has the same figure at both commits, so no commit is named"


def test_page_has_each_cell_and_night_with_its_commit(tmp_path: Path) -> None:
    tonight, _ = regression("0123456789ab", "ba9876543210")
    first = night(played(matrix(seeds=[1, 2, 4]), 1, judge), "0123456789ab")
    first = first.model_copy(update={"started_at": "2026-01-01T02:00:00Z"})
    page = to_html(Finished(tonight, []), tmp_path, StoredNights(tmp_path, [first, tonight], []))
    assert "<small>0123456789ab</small>" in page
    assert ', commit ba9876543210">' in page
    assert '<td class="violated" title="3 runs: 1 with a violation or failure">✗1</td>' in page
    assert '<td class="holds" title="3 runs, no violation">✓</td>' in page
    assert "1 figure worse than in the baseline" in page
    matrix_outputs.write(Finished(tonight, []), tmp_path)


def test_option_bisect_needs_a_baseline() -> None:
    refused = harness("matrix", "growth_matrix", "--bisect", "5m")
    assert refused.returncode == 2
    assert "--bisect needs --against" in refused.stderr
