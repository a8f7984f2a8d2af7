"""Test the command line without a virtual network: `check`, wrong requests, and exit statuses."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.command import COMMAND, harness, sentences, write_scenario
from tests.harness.mission import CONNECTED, edit, fly, write_exports, write_run

PERFECT = Path(__file__).parents[3] / "scenarios" / "perfect.yaml"


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    return write_run(fly(agents=3, duration_s=400), tmp_path / "run", CONNECTED)


def test_check_of_a_run_directory_shows_six_verdicts(run_dir: Path) -> None:
    done = harness("check", run_dir)
    assert done.returncode == 0
    assert done.stdout.count("holds") == 6
    assert not done.stderr


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_terminal_without_unicode_shows_verdicts(run_dir: Path, encoding: str) -> None:
    edit(run_dir / "agents" / "2.chain.json", lambda export: export["chain"][0].update(timestamp_us=5))
    env = {**os.environ, "PYTHONIOENCODING": encoding}
    done = subprocess.run([*COMMAND, "check", run_dir], env=env, capture_output=True, encoding=encoding, check=False)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "x violated" in done.stdout and "+ holds" in done.stdout


def test_check_gives_characteristics_and_figures_as_json(run_dir: Path) -> None:
    done = harness("check", run_dir, "--json")
    verdict = json.loads(done.stdout)
    assert list(verdict["characteristics"]) == ["1", "2", "3", "4", "5", "6"]
    assert verdict["figures"]["agents"] == 3


def test_violation_has_status_1_and_evidence(run_dir: Path) -> None:
    edit(run_dir / "agents" / "2.chain.json", lambda export: export["chain"][0].update(timestamp_us=5))
    done = harness("check", run_dir)
    assert done.returncode == 1
    assert "✘ violated" in done.stdout
    assert "does not match its block" in " ".join(done.stdout.split())


def test_unreadable_export_has_status_2_and_the_rest_are_checked(tmp_path: Path) -> None:
    paths = write_exports(fly(agents=3, duration_s=400), tmp_path, traces=False)
    paths[1].write_text(paths[1].read_text()[:100])
    done = harness("check", *paths, "--json")
    assert done.returncode == 2
    assert json.loads(done.stdout)["figures"]["agents"] == 2
    assert "truncated or damaged" in sentences(done.stderr)[0]


def test_violation_among_unreadable_exports_has_status_1(tmp_path: Path) -> None:
    paths = write_exports(fly(agents=3, duration_s=400), tmp_path, traces=False)
    paths[1].write_text("")
    edit(paths[0], lambda export: export["chain"][0].update(timestamp_us=5))
    assert harness("check", *paths).returncode == 1


def test_check_without_exports_has_status_2(tmp_path: Path) -> None:
    for arguments in ([tmp_path], [tmp_path / "nowhere"]):
        done = harness("check", *arguments)
        assert done.returncode == 2
        assert str(tmp_path) in sentences(done.stderr)[0]


def test_wrong_scenario_is_refused_in_one_sentence_with_status_2(tmp_path: Path) -> None:
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text("name: x\nnetwork: {loss: 1.5}")
    done = harness("run", scenario, "--out", tmp_path / "run")
    assert done.returncode == 2
    (sentence,) = sentences(done.stderr)
    assert sentence == f"{scenario}: `network.loss` is 1.5: it should be less than or equal to 1"
    assert not (tmp_path / "run").exists()


def test_unknown_option_has_status_2(tmp_path: Path) -> None:
    assert harness("run", "x.yaml", "--lossy").returncode == 2


@pytest.mark.parametrize("speedup", ["0", "-1", "nan", "1e9"])
def test_impossible_speedup_is_refused(tmp_path: Path, speedup: str) -> None:
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text("name: x")
    done = harness("run", scenario, "--speedup", speedup, "--out", tmp_path / "run")
    assert done.returncode == 2
    assert "speedup" in done.stderr
    assert not (tmp_path / "run").exists()


def test_doctor_reports_requirements_as_text_and_json() -> None:
    as_json = harness("doctor", "--json")
    findings = json.loads(as_json.stdout)
    assert {"name", "ok", "needed", "detail", "way_out"} <= findings[0].keys()
    able = all(finding["ok"] for finding in findings if finding["needed"])
    assert as_json.returncode == (0 if able else 3)
    as_text = harness("doctor")
    assert as_text.returncode == as_json.returncode
    for finding in findings:
        assert finding["name"] in as_text.stdout


def test_run_in_virtual_time_reports_that_no_vehicles_fly(tmp_path: Path) -> None:
    done = harness("run", PERFECT, "--backend", "sim", "--seed", "1", "--out", tmp_path / "run")
    assert done.returncode == 0
    assert "Virtual time has no telemetry" in done.stdout
    assert (tmp_path / "run" / "report.html").exists()


def test_virtual_time_refuses_ardupilot(tmp_path: Path) -> None:
    asked = ("run", PERFECT, "--backend", "sim", "--vehicles", "ardupilot", "--out", tmp_path / "run")
    done = harness(*asked)
    assert done.returncode == 2
    assert "`vehicles.kind: ardupilot` needs real processes" in " ".join(sentences(done.stderr))
    assert not (tmp_path / "run").exists()


def test_option_ucp_agent_replaces_the_agents_of_a_scenario(tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path, agent_command={"3": ["./missing"]}, vehicles={"kind": "none"})
    ours = [sys.executable, "-P", "-m", "ucp.node"]
    agents = ("--ucp-agent", " ".join(ours), "--ucp-agent", f"2={' '.join(ours)}")
    done = harness("run", scenario, *agents, "--backend", "sim", "--seed", "1", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["scenario"]["agent_command"] == {"1": ours, "2": ours, "3": ours}


@pytest.mark.parametrize(
    ("agents", "sentence"),
    [
        (["9=mine"], "agent_command names vehicle 9, which is not on the roster"),
        (["mine", "yours"], "--ucp-agent names two programs for all"),
        (["2="], "--ucp-agent is empty: name a program"),
    ],
)
def test_impossible_option_ucp_agent_is_refused_in_one_sentence(
    agents: list[str], sentence: str, tmp_path: Path
) -> None:
    options = [word for agent in agents for word in ("--ucp-agent", agent)]
    done = harness("run", write_scenario(tmp_path), *options, "--out", tmp_path / "run")
    assert done.returncode == 2
    assert sentence in " ".join(sentences(done.stderr))
    assert not (tmp_path / "run").exists()
