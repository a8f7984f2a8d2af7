"""Test that losses and restarts of vehicles have the same effect with real processes and in virtual time."""

import json
import re
import signal
from pathlib import Path
from typing import Any

import pytest

from harness.archive.traces import read_trace
from harness.run.simulate import simulate
from harness.scenario import Scenario
from tests.harness.command import Running, harness, processes, sentences, write_scenario

pytestmark = pytest.mark.lab

STORY: dict[str, Any] = {
    "agents": 5,
    "duration_s": 400,
    "speedup": 50,
    "events": {"source": "random", "mean_s": 5},
    "timeline": [
        {"at_s": 60, "kill": [2]},
        {"at_s": 100, "reboot": [3], "down_s": 20, "disk": "kept"},
        {"at_s": 140, "pause": [1]},
        {"at_s": 160, "resume": [1]},
        {"at_s": 180, "crash": [4]},
        {"at_s": 220, "reboot": [5], "down_s": 20, "disk": "lost"},
        {"at_s": 260, "restart": [2]},
    ],
    "final_reconcile": True,
}


def summary_of(faults: list[dict[str, Any]]) -> list[tuple[Any, ...]]:
    return [(fault["what"], fault.get("agents"), fault.get("disk")) for fault in faults]


@pytest.mark.any_user
def test_attrition_is_the_same_with_processes_and_in_virtual_time(tmp_path: Path) -> None:
    scenario, out = write_scenario(tmp_path, **STORY, vehicles={"kind": "embedded"}), tmp_path / "run"
    done = harness("run", scenario, "--seed", 5, "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    record = json.loads((out / "run.json").read_text())
    simulated = simulate(Scenario.model_validate({"name": "test", **STORY}), 5)
    assert summary_of(record["faults"]) == summary_of([fault.model_dump() for fault in simulated.played.faults])
    assert {one["verdict"] for one in record["characteristics"].values()} == {"holds"}
    keys = ("outcome", "restarts", "reboots")
    assert {agent: [one[key] for key in keys] for agent, one in record["agents"].items()} == {
        agent: [getattr(one, key) for key in keys] for agent, one in simulated.played.agents.items()
    }
    assert [bool(record["agents"][agent]["completed_before"]) for agent in "12345"] == [False, True, False, True, True]
    assert [(loss["what"], loss["vehicles"]) for loss in record["survival"]["losses"]] == [
        ("kill", [2]),
        ("crash", [4]),
        ("reboot", [5]),
    ]
    assert re.search(r"^at \d+ s vehicle 2 was lost \(kill\), and with it", done.stdout, re.MULTILINE)
    assert not processes(out)
    _check_files_of_incarnations(out)
    _check_fallen_vehicle(record["vehicles"]["4"])


def _check_files_of_incarnations(out: Path) -> None:
    agents, vehicles = out / "agents", out / "vehicles"
    assert {path.name for path in agents.iterdir() if path.is_dir()} == {"2-2", "3-2", "5-2"}
    assert {path.name for path in vehicles.iterdir()} == {"1", "2", "2-2", "3", "4", "5"}
    assert (vehicles / "2-2" / "telemetry.tlog").stat().st_size > 1000
    assert not list(out.rglob("*.control"))
    assert sorted(path.name for path in agents.glob("*.store")) == ["3.store"]
    assert not list(agents.glob("4.chain.json")), "the data of a crashed agent is lost"
    for agent, boots in (("2", False), ("3", True), ("5", False)):
        trace = read_trace(agents / f"{agent}.trace.jsonl")
        last = read_trace(agents / f"{agent}-2" / f"{agent}.trace.jsonl")
        assert trace is not None and last is not None and not trace.problem
        first_runs, second_runs = ([run for _, run in incarnation] for incarnation in trace.incarnations())
        assert second_runs == last.runs
        assert max(run.t for run in first_runs) < min(run.t for run in second_runs)
        assert (second_runs[0].trigger.kind == "boot") == boots
        assert "ready" in (agents / f"{agent}.log").read_text()
        assert (agents / f"{agent}.chain.json").read_text() == (
            agents / f"{agent}-2" / f"{agent}.chain.json"
        ).read_text()


def _check_fallen_vehicle(vehicle: dict[str, Any]) -> None:
    assert not vehicle["armed"]
    assert vehicle["altitude_m"] < 1


@pytest.mark.any_user
def test_agent_paused_to_the_end_still_exports(tmp_path: Path) -> None:
    keys = {"vehicles": {"kind": "none"}, "final_reconcile": True, "settle": {"limit_s": 200}}
    scenario = write_scenario(tmp_path, **keys, timeline=[{"at_s": 100, "pause": [3]}])
    done = harness("run", scenario, "--seed", 1, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stdout + done.stderr
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert not record["settled"]
    assert not record["final_reconcile"]["complete"]
    assert {agent["outcome"] for agent in record["agents"].values()} == {"exported"}


@pytest.mark.any_user
def test_crash_of_a_second_incarnation_fails_the_run(tmp_path: Path) -> None:
    timeline = [{"at_s": 20, "kill": [2]}, {"at_s": 40, "restart": [2]}]
    scenario = write_scenario(tmp_path, duration_s=100_000, vehicles={"kind": "none"}, timeline=timeline)
    run = Running(scenario, tmp_path / "run")
    second = run.out / "agents" / "2-2" / "2.trace.jsonl"
    run.wait_for(lambda: second.exists() and second.read_text().count("\n") > 1, "the second incarnation")
    run.signal_agent(2, signal.SIGKILL)
    status, _, err = run.end()
    assert status == 1
    assert sentences(err)[0].startswith("agent 2 ended by itself with SIGKILL; its log is agents/2-2/2.log")
    assert run.record()["agents"]["2"]["outcome"] == "crashed"


@pytest.mark.any_user
def test_interrupted_run_records_a_rebooting_agent(tmp_path: Path) -> None:
    timeline = [{"at_s": 20, "reboot": [2], "down_s": 90_000, "disk": "kept"}]
    scenario = write_scenario(tmp_path, duration_s=100_000, vehicles={"kind": "none"}, timeline=timeline)
    run = Running(scenario, tmp_path / "run")
    network = run.out / "network.jsonl"
    run.wait_for(lambda: network.exists() and '"reboot"' in network.read_text(), "the brown-out")
    run.process.send_signal(signal.SIGINT)
    status, _, _ = run.end()
    assert status == 130
    record = run.record()
    assert record["agents"]["2"]["outcome"] == "rebooting"
    assert record["characteristics"]["5"]["verdict"] == "not applicable"
    assert not processes(run.out)
