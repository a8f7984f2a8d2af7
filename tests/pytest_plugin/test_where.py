"""Test the options that select where a run takes place: in User Mode Linux, or in containers."""

import json
import os
import re
import sys
from pathlib import Path

import pytest

from netem import uml
from tests.pytest_plugin.inner import run, run_directories, write_scenario

pytest_plugins = "pytester"

FIRST_AND_LAST = """
    import pytest
    from netem import uml

    @pytest.mark.swarm(agents=2, speedup=50, network={"delay": 0.2}, events={"source": "random", "mean_s": 5})
    def test_swarm(swarm):
        assert uml.inside()
        swarm.wait_for("receive_commit_block", "committed", limit_s=300)

    def test_fails(tmp_path):
        (tmp_path / "left").touch()
        assert False, f"see {tmp_path}"
"""


@pytest.mark.uml
@pytest.mark.any_user
def test_session_runs_in_user_mode_linux(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    pytester.makepyfile(FIRST_AND_LAST)
    monkeypatch.setenv("TMPDIR", str(pytester.mkdir("temporary")))
    options = ("-p", "no:cacheprovider", "--ucp-kernel", "uml", "--ucp-backend", "process", "--ucp-keep", "kept")
    result = pytester.run(sys.executable, "-m", "pytest", *options)
    result.assert_outcomes(passed=1, failed=1)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    (kept,) = run_directories(pytester)
    record = json.loads((kept / "run.json").read_text())
    assert record["engine"] == "netem" and "User Mode Linux" in record["versions"]["kernel"]
    (named,) = set(re.findall(r"AssertionError: see (/\S+)", result.stdout.str()))  # the summary may say it again
    assert Path(named, "left").exists(), "what a failed test leaves outlives the guest"


def test_without_user_mode_linux_processes_are_skipped_with_the_reason(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    if uml.inside():
        pytest.skip("this is User Mode Linux")
    write_scenario(pytester, "s.yaml", expect={"backends": ["process", "docker", "sim"]})
    pytester.makepyfile("""
    import pytest

    @pytest.mark.parametrize("backend", ["process", "sim"])
    def test_swarm(request, backend):
        request.node.add_marker(pytest.mark.swarm(backend=backend))
        request.getfixturevalue("swarm").run_for(10)
    """)
    monkeypatch.setenv("PATH", os.devnull)
    result = run(pytester, "--ucp-kernel", "uml", "-rs", ".", "s.yaml")
    result.assert_outcomes(passed=2, skipped=3)
    result.stdout.fnmatch_lines_random(
        [
            "SKIPPED *--ucp-kernel uml: User Mode Linux is not installed (Debian, Ubuntu: apt install *",
            "SKIPPED *--backend docker does not work with --kernel uml, *",
        ]
    )


def test_containers_are_made_of_this_machines_files(pytester: pytest.Pytester) -> None:
    write_scenario(pytester, "s.yaml", expect={})
    pytester.makepyfile("def test_swarm(swarm): swarm.run_for(9)")
    run(pytester, "--ucp-image-from-host", "--ucp-keep", "kept", ".", "s.yaml").assert_outcomes(passed=2)
    records = [json.loads((kept / "run.json").read_text()) for kept in run_directories(pytester)]
    assert [record["scenario"]["docker"]["image_from_host"] for record in records] == [True, True]


@pytest.mark.docker
def test_containers_of_this_machines_files_follow_a_story(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
    import pytest

    @pytest.mark.swarm(agents=2, speedup=50, events={"source": "random", "mean_s": 5})
    def test_containers(swarm):
        swarm.wait_for("receive_commit_block", "committed", limit_s=300)
        with pytest.raises(Exception, match="`hold` needs virtual time: use --backend sim"):
            swarm.hold("Commit Block")
    """)
    run(pytester, "--ucp-backend", "docker", "--ucp-image-from-host").assert_outcomes(passed=1)
