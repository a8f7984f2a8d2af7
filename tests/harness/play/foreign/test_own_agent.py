"""Test that the harness's own agent gives the same run as a separate program and inside the simulation."""

import json
from operator import itemgetter
from pathlib import Path
from typing import Any

from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.run.simulate import Simulated, simulate
from harness.scenario import Scenario
from tests.harness.play.foreign.agents import OURS, played_by
from tests.harness.virtual import scenario

EVENTFUL: dict[str, Any] = {
    "agents": 3,
    "duration_s": 500,
    "network": {"loss": 0.2, "duplicate": 0.1},
    "events": {"source": "random", "mean_s": 8},
    "clocks": {1: {"offset_s": -3.5, "drift": 0.001}, 3: {"offset_s": 10}},
    "quirks": {"vote_while_reconciling": {"agents": [3]}, "ignore_commit": 0.2},
    "timeline": [
        {"at_s": 60, "pause": [2]},
        {"at_s": 90, "resume": [2]},
        {"at_s": 100, "kill": [1]},
        {"at_s": 150, "restart": [1]},
        {"at_s": 170, "flood": {"per_s": 2, "for_s": 20}},
        {"at_s": 220, "reboot": [3], "down_s": 10, "disk": "kept"},
        {"at_s": 300, "partition": [[1, 2], [3]]},
        {"at_s": 400, "heal": True},
    ],
    "final_reconcile": True,
}


def results_of(simulated: Simulated) -> dict[str, Any]:
    agents = [agent.model_dump(exclude={"command", "version"}) for agent in simulated.played.agents.values()]
    return {
        "exports": [export.model_dump() for export in simulated.evidence.exports.values()],
        "traces": [[run.to_line() for run in trace.runs] for trace in simulated.evidence.traces.values()],
        "asides": [[(at, aside.to_line()) for at, aside in it.asides] for it in simulated.evidence.traces.values()],
        "result": simulated.result.to_json(),
        "agents": agents,
        "settled": (simulated.played.settled, simulated.played.mission_s, simulated.played.final_reconcile),
    }


def both(one: Scenario, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    foreign = one.model_copy(update={"agent_command": OURS})
    own = simulate(one, seed, tracing=True, deliver_all=True)
    return results_of(own), results_of(simulate(foreign, seed, tracing=True))


def test_own_agent_behaves_the_same_behind_lines() -> None:
    """The scenario contains all kinds of faults. The second mission uses the same process as the first."""
    for seed in (1, 2):
        within, outside = both(scenario(**EVENTFUL), seed)
        assert within == outside
        assert within["agents"][0]["restarts"] == within["agents"][2]["reboots"] == 1


def test_own_agent_with_keys_behaves_the_same_behind_lines() -> None:
    """The agent encrypts and decrypts datagrams, remembers excluded vehicles after a reboot, and drops the same
    datagrams.
    """
    revoked = {"at_s": 200, "revoke": [1], "heard_by": [2]}
    forged = {"at_s": 120, "forge": {"message": "Commit Block", "sender": 2}}
    keys = {
        **EVENTFUL,
        "quirks": {},
        "timeline": sorted([*EVENTFUL["timeline"], revoked, forged], key=itemgetter("at_s")),
    }
    for security in ({"captured": 2}, {"captured": 2, "seal": True}):
        within, outside = both(scenario(**keys, security=security), 1)
        assert within == outside
        dropped = {reason for agent in within["agents"] for reason in agent["dropped"]}
        assert dropped >= {"replayed", "revoked sender"}


def test_run_directory_with_foreign_agents_equals_memory(tmp_path: Path) -> None:
    one = played_by({2: OURS}, agents=3, duration_s=200, network={"loss": 0.1})
    finished = run(one, 1, tmp_path / "run", SilentProgress(), "sim")
    assert finished.exit_status == 0
    in_memory = simulate(one, 1, tracing=True)
    assert finished.result.to_json() == in_memory.result.to_json()
    assert finished.played.agents == in_memory.played.agents
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["agents"]["2"]["command"] == OURS
    assert (tmp_path / "run" / "agents" / "2.log").exists()
