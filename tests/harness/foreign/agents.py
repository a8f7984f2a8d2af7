"""Agents of other makes for virtual time: ours behind standard input and output, and small ones that go wrong."""

import sys
from pathlib import Path
from typing import Any

from harness.scenario import Scenario
from tests.harness.virtual import scenario

OURS = [sys.executable, "-P", "-m", "ucp.node"]

SMALL = """
import json, sys
STATUS = {"ok": True, "started": True, "idle": True, "reconcile_in_progress": False, "chain": 0, "deque": 0, "stack": 0,
          "completed": 0, "reconciles": 0, "top_chain_hash": "00" * 32, "handled": 0, "bytes_sent": 0}
def answer(given):
    told = {"answer": STATUS} if given.get("command") == "status" else {}
    return {"sent": [], "timer": None, "trace": [], **told}
for number, line in enumerate(sys.stdin):
    given = json.loads(line)
    said = answer(given)
    CODE
    print(json.dumps(said), flush=True)
"""
"""An agent that does nothing but answer; CODE may have it go wrong."""


def small(directory: Path, code: str = "pass") -> list[str]:
    """The command of an agent that does nothing, but for `code`, which runs before each answer is written."""
    path = directory / "agent.py"
    path.write_text(SMALL.replace("CODE", code.replace("\n", "\n    ")))
    return [sys.executable, "-S", "-E", str(path)]


def played_by(command: list[str] | dict[int, list[str]], **keys: Any) -> Scenario:
    return scenario(agent_command=command, **keys)
