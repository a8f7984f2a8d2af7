"""Run pytest on a small project inside a test, and read its output."""

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

# Imported before pytester saves the imported modules, so that inner runs are fast.
import harness.pytest_plugin._items
import harness.report  # noqa: F401

SCENARIOS = Path(__file__).parents[2] / "scenarios"


def run(pytester: pytest.Pytester, *arguments: object) -> pytest.RunResult:
    """Run the tests of the small project in this process."""
    return pytester.runpytest_inprocess("-p", "no:cacheprovider", *map(str, arguments))


def write_scenario(pytester: pytest.Pytester, file: str, **keys: Any) -> Path:
    """Write a scenario that takes little time, as YAML with one key in each line."""
    keys = {"name": "inner", "agents": 3, "duration_s": 100, "vehicles": {"kind": "none"}, **keys}
    path = pytester.path / file
    path.write_text("".join(f"{key}: {json.dumps(value)}\n" for key, value in keys.items()))
    return path


def report(result: pytest.RunResult) -> Path:
    """Return the path of the report that the output of a failing test names. The report must exist."""
    found = re.search(r"^report: (\S+)$", result.stdout.str(), re.MULTILINE)
    assert found, result.stdout.str()
    path = Path(found[1])
    assert "<html" in path.read_text()
    return path


def no_internals(result: pytest.RunResult) -> None:
    """Check that the output contains the name of the test and sentences, but no source line of the harness."""
    shown = result.stdout.str() + result.stderr.str()
    assert "Traceback" not in shown
    assert not re.search(r"harness/(?!harness/|pytest_plugin/_?judged_run\.py:\d+: )\w+[\w/]*\.py:\d+", shown), shown
    assert "During handling" not in shown


def run_directories(pytester: pytest.Pytester) -> list[Path]:
    """Return the run directories in the project and in pytest's temporary directories."""
    temporary = Path(os.environ["PYTEST_DEBUG_TEMPROOT"])
    return [path.parent for place in (pytester.path, temporary) for path in place.rglob("run.json")]
