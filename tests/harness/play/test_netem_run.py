"""Test a whole run of agents over the kernel's netem. `make test-netem` plays it in User Mode Linux."""

import json
from pathlib import Path

import pytest

from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.scenario import Scenario
from tests.machine import require

pytestmark = pytest.mark.lab

LOSS = {"p": 0.02, "r": 0.38}  # 5 % in bursts of 2.6 messages
DELAY = {"mean_s": 0.1, "jitter_s": 0.02, "distribution": "normal"}


def test_agents_agree_over_delays_and_bursts_of_loss(tmp_path: Path) -> None:
    require("netem")
    scenario = Scenario.model_validate(
        {
            "name": "netem",
            "agents": 3,
            "duration_s": 60,
            "speedup": 10,
            "vehicles": {"kind": "none"},
            "events": {"source": "random", "mean_s": 5},
            "network": {"loss": LOSS, "delay": DELAY},
            "final_reconcile": True,
        }
    )
    finished = run(scenario, 1, tmp_path / "run", SilentProgress())
    assert finished.played.outcome == "completed", finished.played.outcome_detail
    assert finished.played.engine == "netem"
    assert finished.exit_status == 0
    verdicts = {number: one.verdict for number, one in finished.result.characteristics.items()}
    assert [verdicts[number] for number in ("2", "3", "4")] == ["holds"] * 3
    assert (finished.result.figures["blocks"] or 0) > 0
    start, *_, end = map(json.loads, (tmp_path / "run" / "network.jsonl").read_text().splitlines())
    for receiver in start["applied"]["receivers"].values():
        assert receiver["loss"] == LOSS | {"loss_good": 0.0, "loss_bad": 1.0}
        # Delays are in mission seconds. The speedup of 10 divides the delay in the kernel by 10.
        assert receiver["delay"] == {"mean_s": 0.01, "jitter_s": 0.002, "distribution": "normal"}
    assert all(receiver["passed"] > 0 for receiver in end["counters"]["receivers"].values())
