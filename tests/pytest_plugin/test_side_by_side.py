"""Test runs in parallel tests, interrupted tests, and tests among tests that do not use the plugin."""

import json
import os
import signal
import subprocess
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from harness.scenario.scenario import MAX_DURATION_S
from tests.harness.command import processes
from tests.pytest_plugin.inner import run, run_directories, write_scenario

pytest_plugins = "pytester"

DEADLINE_S = 120.0

PROJECT = """
    import pytest

    @pytest.mark.parametrize("number", range(6))
    @pytest.mark.xdist_group("stories")
    def test_story(swarm, number):
        swarm.partition([1, 2])
        swarm.run_for(200)
        swarm.heal()
        swarm.wait_idle()
        assert swarm.characteristic(6).holds

    @pytest.mark.scenario("s.yaml")
    def test_scenario(scenario):
        assert scenario.characteristic(3).holds

    @pytest.mark.swarm(expect={"characteristics": {3: "violated"}})
    def test_that_fails(swarm):
        swarm.run_for(10)
"""


@pytest.mark.parametrize("workers", [("-n", "1"), ("-n", "4"), ("-n", "2", "--dist=loadgroup")])
def test_results_do_not_depend_on_the_number_of_workers(pytester: pytest.Pytester, workers: tuple[str, ...]) -> None:
    pytester.makepyfile(PROJECT)
    write_scenario(pytester, "s.yaml", expect={"seeds": [1, 2, 3]})
    result = pytester.runpytest_subprocess(*workers, "--ucp-keep", "kept", "s.yaml", ".")
    result.assert_outcomes(passed=10, failed=1)
    assert "characteristic 3, single copy: holds" in result.stdout.str()
    assert len(list((pytester.path / "kept").iterdir())) == len(run_directories(pytester)) == 11


@pytest.mark.lab
@pytest.mark.any_user
def test_eight_simultaneous_labs_do_not_interfere(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
    import json, pathlib, pytest, time

    @pytest.mark.parametrize("number", range(8))
    @pytest.mark.swarm(agents=2, backend="process", speedup=20)
    def test_lab(swarm, number):
        pathlib.Path(f"here-{number}").touch()
        deadline = time.monotonic() + 60
        while len(list(pathlib.Path().glob("here-*"))) < 8:
            assert time.monotonic() < deadline, "there were never eight"
            swarm.run_for(5)
        swarm.run_for(40)
        swarm.characteristic(1)
        record = json.loads((swarm.directory / "run.json").read_text())
        assert not any(agent["dropped"] for agent in record["agents"].values())
    """)
    result = pytester.runpytest_subprocess("-n", "8")
    result.assert_outcomes(passed=8)
    assert not processes(pytester.path)


@pytest.mark.parametrize("backend", [pytest.param("process", marks=pytest.mark.lab), "sim"])
@pytest.mark.parametrize("what", ["swarm", "s.yaml"])
def test_ctrl_c_leaves_a_complete_run_and_no_process(pytester: pytest.Pytester, backend: str, what: str) -> None:
    write_scenario(pytester, "s.yaml", duration_s=MAX_DURATION_S, settings={"vote_timeout_s": 1}, expect={})
    pytester.makepyfile("""
    def test_swarm(swarm):
        swarm.run_for(1e7)
    """)
    project = pytester.popen(
        [
            sys.executable,
            "-m",
            "pytest",
            *(["s.yaml"] if what == "s.yaml" else []),
            "--ucp-backend",
            backend,
            "--ucp-keep",
            "kept",
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL,
    )
    try:
        deadline = time.monotonic() + DEADLINE_S
        while not any(path.stat().st_size > 2000 for path in pytester.path.glob("kept/*/agents/*.trace.jsonl")):
            assert project.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        os.kill(project.pid, signal.SIGINT)
        said, _ = project.communicate(timeout=DEADLINE_S)
    finally:
        project.kill()
    assert project.returncode == pytest.ExitCode.INTERRUPTED, said.decode()
    assert b"KeyboardInterrupt" in said
    assert not processes(pytester.path)
    (left,) = run_directories(pytester)
    record = json.loads((left / "run.json").read_text())
    assert (record["outcome"], record["characteristics"]["3"]["verdict"]) == ("interrupted", "holds")
    assert (left / "report.html").exists()


def test_project_without_the_plugin_imports_nothing(pytester: pytest.Pytester) -> None:
    for number in range(3):
        (pytester.path / f"{number}.yaml").write_text("name: x\njobs: []\n")
    pytester.makepyfile("""
    import sys

    def test_theirs():
        assert {name for name in sys.modules if name.split(".")[0] in ("harness", "ucp", "netem", "pydantic")} == {
            "harness", "harness.backend_names", "harness.compiled", "harness.pytest_plugin",
            "harness.pytest_plugin._stash", "harness.pytest_plugin._yaml_files",
        }
    """)
    pytester.makeini("[pytest]\ntestpaths = .\naddopts = -p no:hypothesispytest")
    pytester.runpytest_subprocess().assert_outcomes(passed=1)


def test_fixtures_and_markers_need_no_import(pytester: pytest.Pytester) -> None:
    (found,) = entry_points(group="pytest11", name="ucp-harness")
    assert found.value == "ucp_harness_pytest"
    result = run(pytester, "--markers")
    result.stdout.fnmatch_lines(["@pytest.mark.swarm(*", "@pytest.mark.scenario(*"])
    pytester.makepyfile("def test_story(swarm): swarm.run_for(10)")
    pytester.makeini("[pytest]\naddopts = --strict-markers --strict-config -W error")
    run(pytester).assert_outcomes(passed=1)


@pytest.mark.parametrize("ours", ["harness", "ucp", "sitl", "netem"])
def test_project_with_a_package_of_the_same_name_keeps_its_tests(pytester: pytest.Pytester, ours: str) -> None:
    package = pytester.mkpydir(ours)
    (package / "theirs.py").write_text("ANSWER = 42")
    pytester.makepyfile(f"""
    import pytest
    from {ours}.theirs import ANSWER

    def test_theirs():
        assert ANSWER == 42

    @pytest.mark.swarm(agents=3)
    def test_story(swarm):
        swarm.run_for(10)
    """)
    pytester.makeconftest("")
    for command in ([sys.executable, "-m", "pytest"], [Path(sys.executable).with_name("pytest")]):
        result = pytester.run(*command, "--strict-markers")
        result.assert_outcomes(passed=1, errors=1)
        result.stdout.fnmatch_lines([f"*ucp-harness is not importable: *{ours} has the name of one of its packages; *"])
