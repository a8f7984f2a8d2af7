"""Test the agent for small machines in MicroPython (`ucp/contract/examples/micropython`)."""

import json
import os
from pathlib import Path

import pytest

import ucp
from harness.conformance import cases
from harness.conformance._state_space import VARIANTS, explore
from harness.conformance.cases import ALL_CASES
from harness.conformance.conformance_run import ConformanceRequest, conform
from harness.conformance.vectors import VectorSet
from tests.harness.command import harness, write_scenario
from tests.machine import require_micropython

pytestmark = pytest.mark.lab

LAUNCHER = Path(ucp.__path__[0]) / "contract" / "examples" / "micropython" / "small_agent.sh"
LEFT_OUT = {
    "SIGINT exports the chain, exit status 0": "an agent on a small machine may leave out SIGINT",
    "a killed agent restarts with its chain, and proposes the waiting block": "this agent lacks the feature store",
    "the first line of the trace describes the mission": "the agent writes no trace",
}
REQUIRED = {
    "SIGTERM exports the chain, exit status 0",
    "SIGTERM twice during a reconcile exports the chain once, exit status 0",
    "a chain export replaces the earlier one in one step",
    "a wrong mission file gives an error and exit status 2",
    "an unknown feature gives an error and exit status 127",
    "malformed datagrams are dropped and change nothing",
    "the agent leaves no control socket and no other files at its end",
    "the control socket answers each line, including invalid ones",
    "two simultaneous clients of the control socket are both answered",
}


@pytest.fixture(autouse=True)
def micropython(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(require_micropython()).parent
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


@pytest.mark.any_user
def test_small_agent_passes_its_profile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    played = [case for case in ALL_CASES if case.name in {*LEFT_OUT, *REQUIRED}]
    monkeypatch.setattr(cases, "ALL_CASES", played)
    steps = list(explore(VARIANTS["default"]))
    wanted = {step.key: step for step in steps if len(step.path) <= 3 and step.before.activity != "voting"}
    vectors = [VectorSet(VARIANTS["default"], steps, wanted)]
    results = conform(
        ConformanceRequest((str(LAUNCHER),), None, None, small=True), tmp_path, lambda count, total: None, vectors
    )
    assert not results.failures, [case.wrong for case in results.failures]
    assert {case.name for case in results.cases if case.verdict == "passed"} == REQUIRED
    assert {case.name: case.reason for case in results.cases if case.verdict == "not applicable"} == LEFT_OUT
    assert sum(row.passed for row in results.rows()) == len(wanted) + len(REQUIRED)
    assert "the test applied the profile for small machines" in results.notes


@pytest.mark.any_user
def test_small_agent_flies_with_the_reference(tmp_path: Path) -> None:
    path = write_scenario(
        tmp_path,
        duration_s=200,
        speedup=10,
        vehicles={"kind": "none"},
        events={"source": "random", "mean_s": 10},
        network={"loss": 0.1},
        agent_command={"2": [str(LAUNCHER)]},
        timeline=[{"at_s": 100, "kill": [2]}, {"at_s": 120, "restart": [2]}],
        final_reconcile=True,
    )
    done = harness("run", path, "--seed", 3, "--out", tmp_path / "run", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["agents"]["2"]["version"] == "small agent in MicroPython"
    assert record["agents"]["2"]["restarts"] == 1
    assert [record["characteristics"][key]["verdict"] for key in "356"] == ["holds"] * 3
    export = json.loads((tmp_path / "run/agents/2.chain.json").read_text())
    assert len(export["chain"]) > 3


def test_large_machine_must_refuse_what_a_small_one_accepts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "the control socket answers each line, including invalid ones"
    monkeypatch.setattr(cases, "ALL_CASES", [case for case in ALL_CASES if case.name == name])
    results = conform(ConformanceRequest((str(LAUNCHER),), None, None), tmp_path, lambda count, total: None, [])
    assert [case.verdict for case in results.cases] == ["failed"]
