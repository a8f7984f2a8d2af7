"""Run the jobs of a build server's workflow in a local directory, without the build server.

The shell steps run with a clean environment. `PATH` contains the directories of the system, and a directory in which a
test replaces programs that need a network or much time. If a step uses an action of the build server that moves files,
such as caches and artefacts, this module imitates the action. It skips all other actions. The test fails if a workflow
uses an unknown name or function in an expression.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

REPOSITORY = Path(__file__).parents[1]
NIGHT = ".github/actions/night"
SKIPPED = {"actions/checkout", "actions/setup-python", "actions/download-artifact"}
DEADLINE_S = 120.0
_EXPRESSION = re.compile(r"\$\{\{(.*?)\}\}")


class Names(dict[str, Any]):
    """A mapping that expressions of a workflow can use, such as `github`. Its values can also be read as attributes."""

    def __getattr__(self, name: str) -> Any:
        return self[name]


def load(path: Path) -> dict[str, Any]:
    document: dict[str, Any] = yaml.load(path.read_text(), _TextLoader)  # noqa: S506  (a SafeLoader)
    return document


class _TextLoader(yaml.SafeLoader):
    """A loader that reads all scalars as texts. In YAML, the key `on` would otherwise be the value true."""


_TextLoader.yaml_implicit_resolvers = {}


@dataclass
class Runner:
    """A runner with one workspace. Its caches are kept from job to job."""

    workspace: Path
    tools: Path
    """A directory with programs. They replace the programs of the system that have the same names."""
    caches: dict[str, Path] = field(default_factory=dict)
    """The directory with the saved files of each cache key. The oldest key is first."""
    artifacts: dict[str, list[Path]] = field(default_factory=dict)
    """The paths of each artefact of the last job."""
    github: Names = field(default_factory=Names)
    summary: str = ""

    def play(self, workflow: Path, job: str, run_id: int) -> dict[str, str]:
        """Play a job. Return the outcome of each step: "success", "failure" or "skipped"."""
        self.artifacts.clear()
        self.github = Names(run_id=str(run_id), run_attempt="1", job=job, token="")
        return _Steps(self, Names()).play(load(workflow)["jobs"][job]["steps"])

    def restore(self, path: str, keys: list[str]) -> None:
        for key in keys:
            found = [name for name in self.caches if name.startswith(key)]
            if found:
                _copy(self.caches[found[-1]] / path, self.workspace / path)
                return

    def save(self, path: str, key: str) -> None:
        if key not in self.caches and (self.workspace / path).exists():
            self.caches[key] = self.tools.parent / f"cache-{len(self.caches)}"
            _copy(self.workspace / path, self.caches[key] / path)


class _Steps:
    """The steps of a job, or of an action that a job uses."""

    def __init__(self, runner: Runner, inputs: Names, action: Path | None = None) -> None:
        self._runner, self._action = runner, action
        self._inputs, self._outcomes = inputs, Names()
        self._failed = False

    def play(self, steps: list[dict[str, Any]]) -> dict[str, str]:
        outcomes: dict[str, str] = {}
        for step in steps:
            name = step.get("name") or step.get("uses") or step["run"]
            outcome = self._outcome(step, outcomes)
            self._failed |= outcome == "failure"
            outcomes[name] = outcome
            if "id" in step:
                self._outcomes[step["id"]] = Names(outcome=outcome)
        return outcomes

    def _outcome(self, step: dict[str, Any], outcomes: dict[str, str]) -> str:
        condition = step.get("if", "success()")
        if "cancelled()" not in condition and "failure()" not in condition and self._failed:
            return "skipped"
        if not self._evaluate(condition.strip().removeprefix("${{").removesuffix("}}")):
            return "skipped"
        if "run" in step:
            return "success" if self._run(step) else "failure"
        given = {name: self._filled(value) for name, value in step.get("with", {}).items()}
        if NIGHT in step["uses"]:
            inner = self._night(given)
            outcomes.update(inner)
            return "failure" if "failure" in inner.values() else "success"
        self._imitate(step["uses"].partition("@")[0], given)
        return "success"

    def _run(self, step: dict[str, Any]) -> bool:
        runner = self._runner
        summary = runner.tools.parent / "summary"
        ended = subprocess.run(
            ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", self._filled(step["run"])],
            cwd=runner.workspace,
            env={
                "PATH": f"{runner.tools}:/usr/bin:/bin",
                "HOME": str(runner.tools.parent),
                "GITHUB_STEP_SUMMARY": str(summary),
                "GITHUB_ACTION_PATH": str(self._action),
                "GITHUB_REF_NAME": "v0.0.0",
                **{name: self._filled(value) for name, value in step.get("env", {}).items()},
            },
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )
        sys.stdout.write(f"{step['run']}\n{ended.stdout}{ended.stderr}status {ended.returncode}\n\n")  # if a test fails
        if summary.exists():
            runner.summary = summary.read_text()
        return ended.returncode == 0

    def _night(self, given: Mapping[str, str]) -> dict[str, str]:
        action = load(REPOSITORY / NIGHT / "action.yml")
        assert {*given} <= {*action["inputs"]}, f"the action has no such input: {given}"
        inputs = Names({name: value["default"] for name, value in action["inputs"].items()} | {**given})
        return _Steps(self._runner, inputs, REPOSITORY / NIGHT).play(action["runs"]["steps"])

    def _imitate(self, action: str, given: Mapping[str, str]) -> None:
        if action == "actions/cache/restore":
            self._runner.restore(given["path"], [given["key"], *given.get("restore-keys", "").splitlines()])
        elif action == "actions/cache/save":
            self._runner.save(given["path"], given["key"])
        elif action == "actions/upload-artifact":
            paths = [self._runner.workspace / line for line in given["path"].splitlines()]
            self._runner.artifacts[given["name"]] = [path for path in paths if path.exists()]
        else:
            assert action in SKIPPED, f"this action is not known here: {action}"

    def _filled(self, text: str) -> str:
        return _EXPRESSION.sub(lambda match: str(self._evaluate(match[1])), text)

    def _evaluate(self, expression: str) -> Any:
        """Return the value of an expression. Raises KeyError or NameError for an unknown name."""
        python = re.sub(r"!(?!=)", " not ", expression).replace("&&", " and ").replace("||", " or ")
        names = {
            "github": self._runner.github,
            "inputs": self._inputs,
            "steps": self._outcomes,
            "success": lambda: not self._failed,
            "failure": lambda: self._failed,
            "cancelled": lambda: False,
            "hashFiles": lambda pattern: "digest" if [*self._runner.workspace.glob(pattern)] else "",
        }
        return eval(python.strip(), {"__builtins__": {}}, names)  # noqa: S307  (our own workflows)


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir():
        shutil.copytree(source, target, dirs_exist_ok=True)
    else:
        shutil.copy(source, target)


def write_tool(directory: Path, name: str, script: str) -> None:
    """Write a shell script into the directory of tools, as a program for the runner."""
    directory.mkdir(exist_ok=True)
    (directory / name).write_text(f"#!/bin/sh\n{script}\n")
    (directory / name).chmod(0o755)
    assert os.access(directory / name, os.X_OK)
