"""Test that a new fault needs only one class, and that all parts of the harness then support it."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

HARNESS = Path(__file__).parents[3] / "harness"

STUN = '''
"""Lightning: an agent stops, and continues after some time."""

from collections.abc import Sequence
from dataclasses import dataclass

from harness.scenario.faults.fault import RUNNING, Fault, AgentOperations
from harness.scenario.strict_model import Seconds


@dataclass(frozen=True)
class Stun(Fault):
    """Lightning strikes these agents. They stop for `dazed_s`."""

    dazed_s: Seconds

    what = "stun"
    states_before = (RUNNING,)
    state_after = "stunned"
    suspends_agent = True
    keys_in_words = "`dazed_s`, in mission seconds"
    mark = "M-1-6l2 6h-3l2 6"
    meaning = "struck by lightning"

    def stages(self) -> Sequence[Fault]:
        return [self, EndOfStun(self.at_s + self.dazed_s, self.agents)]

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.pause(agent_id)


class EndOfStun(Fault):
    """The end of a stun."""

    what = "come to"
    is_timeline_key = False
    states_before = ("stunned",)

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.resume(agent_id)
'''
SCENARIO = """
name: stunned
duration_s: 300
events: {source: random, mean_s: 10}
timeline:
  - {at_s: 100, stun: [2], dazed_s: 50}
final_reconcile: true
"""
IN_PYTEST = """
def test_lightning(swarm):
    swarm.run_until(100)
    swarm.stun(2, dazed_s=50)
    swarm.run_for(60)
"""


def test_new_fault_needs_one_file(tmp_path: Path) -> None:
    shutil.copytree(HARNESS, tmp_path / "harness", ignore=shutil.ignore_patterns("__pycache__", "*.png"))
    (tmp_path / "harness/scenario/faults/stun.py").write_text(STUN)
    (tmp_path / "stunned.yaml").write_text(SCENARIO)

    def python(*arguments: str) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        command = [sys.executable, *arguments]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)

    run = [*("-m", "harness.cli", "run", "stunned.yaml"), *("--backend", "sim", "--seed", "1", "--out")]
    played = python(*run, "run")
    assert played.returncode == 0, played.stdout + played.stderr
    record = json.loads((tmp_path / "run/run.json").read_text())
    unchanged = {
        "detail": "agent 2",
        "agents": [2],
        "fully_connected": None,
        "disk": None,
        "by_hand": False,
        "planned_s": None,
    }
    assert record["faults"][:2] == [
        {"at_s": 100, "what": "stun", **unchanged},
        {"at_s": 150, "what": "come to", **unchanged},
    ]
    lines = (tmp_path / "run/agents/2.trace.jsonl").read_text().splitlines()
    times = [float(found[1]) for line in lines if (found := re.search(r'"t":([\d.]+)', line))]
    assert [at_s for at_s in times if at_s < 100]
    assert 150.0 in times
    assert not [at_s for at_s in times if 100 < at_s < 150]
    report = (tmp_path / "run/report.html").read_text()
    assert "agent 2 is paused, 100\u00a0s to 150\u00a0s" in report
    assert report.count('d="M-1-6l2 6h-3l2 6"') == 2  # in the lane, and in the legend
    assert "struck by lightning" in report

    (tmp_path / "stunned.yaml").write_text(SCENARIO.replace(", dazed_s: 50", ""))
    mistaken = python(*run, "mistaken")
    assert mistaken.returncode == 2
    assert "timeline.0" in mistaken.stderr
    assert "a stun needs `dazed_s`, in mission seconds" in mistaken.stderr

    (tmp_path / "test_stroke.py").write_text(IN_PYTEST)
    tested = python("-m", "pytest", "-q", "-p", "no:cacheprovider", "test_stroke.py")
    assert tested.returncode == 0, tested.stdout + tested.stderr
