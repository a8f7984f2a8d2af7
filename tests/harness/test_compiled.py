"""Test that compiled modules give the same results as their sources, and that developers and users can choose which to
use.

The tests compile the modules in a copy of the repository, without optimization. That takes about a minute of processor
time.
"""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from harness.compiled import COMPILED, source_of
from tests.harness.compiled_results import KINDS
from tests.machine import do_without

REPOSITORY = Path(__file__).parents[2]
COPIED = ("harness", "netem", "sitl", "ucp", "scenarios", "docs", "tests", "pyproject.toml")


def python(tree: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the modules of this directory, and return the finished process."""
    inherited = {name: value for name, value in os.environ.items() if name != "UCP_PURE"}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=tree,
        env={**inherited, "PYTHONPATH": str(tree), **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def in_use(tree: Path, before: str = "", **environment: str) -> str:
    """Return which modules a process in this directory uses: compiled modules or their sources.

    The code `before` runs before the import.
    """
    program = f"{before}\nfrom harness import compiled\nimport harness.play.simulation.air as air\n"
    ended = python(tree, "-c", f"{program}print(compiled.in_use, air.__file__, sep='|')", **environment)
    modules, _, file = ended.stdout.strip().partition("|")
    assert (modules == COMPILED) == ("compiled_modules" in file), ended.stdout + ended.stderr
    return modules


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the repository with compiled modules."""
    header = Path(sysconfig.get_path("include"), "Python.h")
    if importlib.util.find_spec("mypyc") is None or shutil.which("cc") is None or not header.exists():
        do_without("cc", "no mypyc, no C compiler or no headers of Python (Debian package `python3-dev`)")
    tree = tmp_path_factory.mktemp("compiled") / "tree"
    tree.mkdir()
    for name in COPIED:
        source = REPOSITORY / name
        if source.is_dir():
            shutil.copytree(source, tree / name, ignore=shutil.ignore_patterns("__pycache__", "compiled_modules"))
        else:
            shutil.copy(source, tree / name)
    ended = python(tree, "-m", "docs.generate.compiled_modules", MYPYC_OPT_LEVEL="0")
    assert ended.returncode == 0, ended.stdout[-2000:] + ended.stderr[-2000:]
    return tree


@pytest.mark.parametrize("kind", KINDS)
def test_compiled_modules_give_the_results_of_their_sources(tree: Path, kind: str) -> None:
    compiled, sources = (
        json.loads(python(tree, "-m", "tests.harness.compiled_results", kind, UCP_PURE=pure).stdout) for pure in "01"
    )
    assert compiled.pop("modules") == COMPILED
    assert sources.pop("modules") == "sources, because UCP_PURE is set"
    assert compiled == sources
    assert len(compiled[kind]) > 5


@pytest.mark.parametrize("tests", ["tests/stories", "tests/harness/field/test_replay.py"])
def test_tests_of_records_pass_with_compiled_modules(tree: Path, tests: str) -> None:
    ended = python(tree, "-m", "pytest", "-q", "-p", "no:cacheprovider", tests)
    assert ended.returncode == 0, ended.stdout[-3000:]


def test_process_uses_compiled_modules_unless_asked_for_sources(tree: Path) -> None:
    assert in_use(tree) == in_use(tree, UCP_PURE="0") == COMPILED
    assert in_use(tree, UCP_PURE="1") == "sources, because UCP_PURE is set"


def test_edited_source_runs_in_place_of_its_compiled_module(tree: Path) -> None:
    source = tree / source_of("netem.medium").relative_to(REPOSITORY)
    original = source.read_text()
    source.write_text(original + "\n")
    try:
        assert in_use(tree) == "sources, because netem.medium has changed since the compilation"
    finally:
        source.write_text(original)


def test_no_compiled_module_replaces_an_imported_one(tree: Path) -> None:
    expected = "sources, because netem.medium was imported before the harness"
    assert in_use(tree, before="import netem.medium") == expected


def test_run_record_and_doctor_name_the_modules_in_use(tree: Path, tmp_path: Path) -> None:
    run = "harness.cli", "run", "loss_15", "--backend", "sim", "--seed", "1", "--out"
    for pure, expected in (("0", COMPILED), ("1", "sources")):
        assert python(tree, "-m", *run, str(tmp_path / pure), UCP_PURE=pure).returncode == 0
        record = json.loads((tmp_path / pure / "run.json").read_text())
        assert record["versions"]["modules"].startswith(expected)
        findings = json.loads(python(tree, "-m", "harness.cli", "doctor", "--json", UCP_PURE=pure).stdout)
        assert next(each["detail"] for each in findings if each["name"] == "Modules").startswith(expected)


def test_no_module_of_the_agent_is_compiled(tree: Path) -> None:
    names = [path.name for path in (tree / "harness/compiled_modules").iterdir()]
    assert len(names) > 30
    assert not [name for name in names if not name.startswith(("harness.", "netem.", "ucp_harness", "manifest"))]
