"""Test that a failing test prints the command that repeats its run outside pytest."""

import re
import shlex
from pathlib import Path

import pytest

from harness.archive.recorded_scenario import load_recorded_scenario
from harness.errors import HarnessError
from tests.harness.command import harness
from tests.pytest_plugin.inner import run, run_directories

pytest_plugins = "pytester"


def test_run_of_a_failing_test_is_played_again_and_explored(pytester: pytest.Pytester, tmp_path: Path) -> None:
    pytester.makepyfile("""
    import pytest

    @pytest.mark.swarm(agents=3, seed=7, network={"loss": 0.3}, quirks={"approve_everything": {"agents": [3]}})
    def test_wrong(swarm):
        swarm.run_for(200)
        swarm.kill(1)
        swarm.run_for(600)
    """)
    failed = run(pytester, "--ucp-keep", "kept in here")
    failed.assert_outcomes(failed=1)
    (said,) = re.findall(r"^again, with seed 7: ucp-harness (run .*)$", failed.stdout.str(), re.MULTILINE)
    command = shlex.split(said)
    again = harness(*command, "--out", tmp_path / "again")
    assert again.returncode == 1, again.stderr
    assert "seed 7" in again.stdout
    same = harness("diff", command[1], tmp_path / "again")
    assert same.returncode == 0 and "identical" in same.stdout, same.stdout
    explored = harness("explore", command[1], "--seeds", 1, "--out", tmp_path / "small.yaml")
    assert explored.returncode == 1 and explored.stdout.startswith("seed 7: steps deviate"), explored.stdout
    assert (tmp_path / "small.yaml").is_file()


@pytest.mark.parametrize(
    ("record", "sentence"),
    [('{"schema": "ucp-run/1"}', "it does not name the scenario; give a scenario"), ("{", "truncated or damaged")],
)
def test_record_without_a_scenario_causes_one_sentence(tmp_path: Path, record: str, sentence: str) -> None:
    (tmp_path / "run.json").write_text(record)
    with pytest.raises(HarnessError, match=sentence):
        load_recorded_scenario(tmp_path)


def test_rerun_of_a_failed_test_ends_where_the_test_failed(pytester: pytest.Pytester, tmp_path: Path) -> None:
    pytester.makepyfile("""
        import pytest

        @pytest.mark.swarm(backend="sim", duration_s=1200)
        def test_blocks(swarm):
            swarm.run_for(400)
            assert swarm.figures["blocks"] > 1000
    """)
    failed = run(pytester, "--ucp-keep", "kept")
    failed.assert_outcomes(failed=1)
    (kept,) = run_directories(pytester)
    harness("run", kept, "--backend", "sim", "--out", tmp_path / "again")
    same = harness("diff", kept, tmp_path / "again")
    assert "identical to the last byte" in same.stdout
