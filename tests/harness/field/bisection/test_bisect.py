"""Test the search in the commit history: it finds the commit that breaks a handler, and leaves no temporary files."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from harness.field.bisection import Outcome, differences
from harness.field.bisection.outcome import AgentResult
from tests.harness.command import COMMAND, harness, sentences

ROOT = Path(__file__).parents[4]
RIGHT = 'if yes < no or (yes == no and core.settings.phase1_tie == "pop"):'
WRONG = RIGHT.replace("yes < no", "yes <= no", 1)
SCENARIO = {"name": "last week", "agents": 5, "duration_s": 600, "network": {"loss": 0.3}}


def git(repository: Path, *arguments: str) -> str:
    who = ["-c", "user.name=A", "-c", "user.email=a@b", "-c", "init.defaultBranch=main"]
    ended = subprocess.run(["git", *who, *arguments], cwd=repository, capture_output=True, text=True, check=True)
    return ended.stdout.strip()


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create a repository with six commits: good, unrelated, not executable, executable again, broken, and unrelated.

    The broken commit breaks a handler.
    """
    path = tmp_path_factory.mktemp("project")
    for package in ("ucp", "harness", "netem", "sitl", "scenarios"):
        shutil.copytree(ROOT / package, path / package, ignore=shutil.ignore_patterns("__pycache__", "*.png"))
    git(path, "init", "--quiet")
    reconcile, commit = path / "ucp/reconcile.py", path / "ucp/commit.py"
    whole = commit.read_text()
    for subject in ("good", "chore", "does not start", "starts again", "broken", "another chore"):
        commit.write_text(f"{whole}\n# {subject}\n" + ("def (\n" if subject == "does not start" else ""))
        if subject == "broken":
            assert RIGHT in reconcile.read_text()
            reconcile.write_text(reconcile.read_text().replace(RIGHT, WRONG))
        git(path, "add", "--all")
        git(path, "commit", "--quiet", "--message", subject)
    return path


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("asked") / "week.yaml"
    path.write_text(json.dumps(SCENARIO))
    return path


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory, scenario: Path) -> Path:
    """Write the records of a flight with correct agents."""
    directory = tmp_path_factory.mktemp("flown")
    played = harness("run", scenario, "--backend", "sim", "--seed", 1, "--out", directory / "run")
    assert (directory / "run/run.json").exists(), played.stderr
    home = directory / "home"
    shutil.copytree(directory / "run/agents", home)
    return home


def test_bisect_finds_the_commit_that_broke_a_scenario(repository: Path, scenario: Path) -> None:
    before = set(Path(tempfile.gettempdir()).glob("ucp-harness-*"))
    ended = harness("bisect", scenario, "--good", "HEAD~5", "--repository", repository, "--json")
    assert ended.returncode == 0, ended.stderr
    document = json.loads(ended.stdout)
    assert [(commit["subject"], "ucp/reconcile.py" in commit["files"]) for commit in document["first"]] == [
        ("broken", True)
    ]
    assert "reconcile_phase_1_timer_expiration" in " ".join(document["changes"])
    parting = document["parting"]["agents"][str(document["parting"]["first"])]["run"]
    assert parting["a"]["handler"] == parting["b"]["handler"] == "reconcile_phase_1_timer_expiration"
    assert git(repository, "status", "--porcelain") == "" and git(repository, "worktree", "list").count("\n") == 0
    assert set(Path(tempfile.gettempdir()).glob("ucp-harness-*")) == before


def test_bisect_finds_the_commit_that_broke_a_record(repository: Path, records: Path) -> None:
    ended = harness("bisect", records, "--good", "HEAD~5", "--repository", repository, "--json")
    assert ended.returncode == 0, ended.stderr
    document = json.loads(ended.stdout)
    assert [commit["subject"] for commit in document["first"]] == ["broken"]
    assert all("reconcile_phase_1_timer_expiration" in change for change in document["changes"])


def test_bisect_skips_untestable_commits_and_reports_equal_outcomes(repository: Path, records: Path) -> None:
    arguments = ["--repository", repository, "--agent", 1]
    alike = harness("bisect", records, "--good", "HEAD~5", "--bad", "HEAD~2", *arguments)
    assert alike.returncode == 1 and "the outcome at HEAD~2 is that at HEAD~5" in alike.stdout
    broken = harness("bisect", records, "--good", "HEAD~5", "--bad", "HEAD~3", *arguments)
    assert broken.returncode == 2
    assert "cannot be tried: it does not start: SyntaxError" in sentences(broken.stderr)[0]
    unknown = harness("bisect", records, "--good", "last-week", *arguments)
    assert unknown.returncode == 2
    assert "no commit 'last-week'; `git log` lists the commits" in sentences(unknown.stderr)[0]


def test_core_that_crashes_on_a_record_has_a_changed_outcome(repository: Path, records: Path, tmp_path: Path) -> None:
    shutil.copytree(repository / "ucp", tmp_path / "ucp", ignore=shutil.ignore_patterns("__pycache__"))
    commit = tmp_path / "ucp/commit.py"
    line = '    """Algorithm 6, '
    before, _, after = commit.read_text().partition(line)
    assert after
    end = after.index('"""\n') + len('"""\n')
    commit.write_text(f'{before}{line}{after[:end]}    raise ZeroDivisionError("no votes")\n{after[end:]}')
    ended = harness("bisect", "--once", records, "--agent", 1, "--repository", tmp_path)
    assert ended.returncode == 1, ended.stderr
    assert "it crashes: ZeroDivisionError: no votes (ucp/commit.py:" in ended.stdout


def test_git_bisect_run_works_with_the_option_once(repository: Path, records: Path, tmp_path: Path) -> None:
    clone = tmp_path / "clone"
    git(tmp_path, "clone", "--quiet", str(repository), str(clone))
    git(clone, "bisect", "start", "HEAD", "HEAD~5")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    once = [sys.executable, "-P", "-m", "harness.cli", "bisect", "--once", str(records), "--agent", "1"]
    run = subprocess.run(
        ["git", "bisect", "run", *once], cwd=clone, env=environment, capture_output=True, text=True, timeout=120
    )
    assert "is the first bad commit" in run.stdout and "broken" in run.stdout, run.stdout + run.stderr


def test_exit_statuses_fit_git_bisect_run(repository: Path, scenario: Path, tmp_path: Path) -> None:
    git(repository, "worktree", "add", "--quiet", "--detach", str(tmp_path / "good"), "HEAD~5")
    kept = tmp_path / "outcome.json"
    try:
        good = harness("bisect", "--once", scenario, "--repository", tmp_path / "good", "--out", kept)
        assert good.returncode == 0, good.stderr
        same = harness("bisect", "--once", scenario, "--repository", tmp_path / "good", "--expect", kept)
        assert same.returncode == 0, same.stdout
        changed = harness("bisect", "--once", scenario, "--repository", repository, "--expect", kept)
        assert changed.returncode == 1 and "deviates" in changed.stdout
    finally:
        git(repository, "worktree", "remove", "--force", str(tmp_path / "good"))
    nothing = harness("bisect", "--once", scenario, "--repository", tmp_path)
    assert (
        nothing.returncode == 125
        and "cannot be tried: it has no directory ucp/; name the repository with --repository" in nothing.stderr
    )
    for mistake in (["--sed", 3], ["--expect", scenario], ["--expect", tmp_path / "none.json"], ["--agent", 1]):
        assert harness("bisect", "--once", scenario, "--repository", repository, *mistake).returncode == 128
    assert harness("bisect", "--once", tmp_path / "none.yaml", "--repository", repository).returncode == 128


def test_interrupted_bisection_leaves_no_files(repository: Path, scenario: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path / "scratch")}
    (tmp_path / "scratch").mkdir()
    process = subprocess.Popen(
        [*COMMAND, "bisect", str(scenario), "--good", "HEAD~5", "--repository", str(repository)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not list((tmp_path / "scratch").glob("ucp-harness-bisect-*/plays-0/play-1/run")):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert sentences(stderr) == ["interrupted; all temporary files are removed"]
    assert list((tmp_path / "scratch").iterdir()) == []


def test_differences_of_outcomes_are_sentences() -> None:
    was = Outcome(subject="x", agents={1: AgentResult(chain=["1.1", "2.1"], top="b")}, verdicts={"6": "holds"})
    now = Outcome(subject="x", agents={1: AgentResult(chain=["1.1"], top="a", deviates="")}, verdicts={"6": "violated"})
    assert differences(was, was) == []
    assert differences(was, now) == [
        "characteristic 6: violated, was holds",
        "agent 1: its first deviation is in no known handler, was nowhere",
        "agent 1: its chain has 1 blocks, was 2; block 2 is not there, was 2.1",
    ]
    crashed = Outcome(subject="x", crashed="KeyError (ucp/core.py:7, send)")
    assert differences(was, crashed) == ["it crashes: KeyError (ucp/core.py:7, send)"]
