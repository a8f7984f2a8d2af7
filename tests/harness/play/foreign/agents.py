"""Provide foreign agents for virtual time: the harness's own agent as a program, and small programs with errors."""

import os
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
"""The source text of an agent that only answers its input. Code in place of CODE can make the agent fail."""

EXPORT = """
if 'mission' in given:
    mission = given['mission']
if given.get('command') == 'export':
    said['answer'] = {
        'schema': 'ucp-chain-export/1', 'agent_id': mission['agent_id'], 'exported_at_us': 0,
        'inception': {'block_data': mission['initial_data'], 'block_hash': '00' * 32, 'chain_hash': '00' * 32},
        'chain': [], 'blocks_to_be_committed': [], 'reconcile_stack': [], 'current_block': {'event_data': ''},
        'completed': [], 'reconcile_in_progress': False, 'idle': True}
"""
"""Code that adds an empty export to the small agent."""


def small(directory: Path, code: str = "pass") -> list[str]:
    """Return the command of a small agent program. The program runs `code` before each answer."""
    path = directory / "agent.py"
    path.write_text(SMALL.replace("CODE", code.replace("\n", "\n    ")))
    return [sys.executable, "-S", "-E", str(path)]


def played_by(command: list[str] | dict[int, list[str]], **keys: Any) -> Scenario:
    return scenario(agent_command=command, **keys)


def living(word: Path) -> list[int]:
    """Return the processes whose command line contains this path."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                said = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if str(word).encode() in said and b"--virtual" in said:
                found.append(int(entry.name))
    return found
