"""Create agents that do not support a feature. They report this when they start or when they get a command."""

import shlex
import sys
from pathlib import Path

LACKING = """\
import sys
import ucp.node
from ucp.control import ControlServer

answer = ControlServer.answer

def lacking(self, line):
    if b'"{command}"' in line:
        return {{"ok": False, "unsupported": True, "error": "mine has no {command}"}}
    return answer(self, line)

ControlServer.answer = lacking
sys.exit(ucp.node.main(sys.argv[1:]))
"""


def refusing_to_start(path: Path, words: str = "mine has no telemetry") -> Path:
    """Write an agent program that prints `words` on standard error and ends with status 127."""
    path.write_text(f"#!/bin/sh\necho {shlex.quote(words)} >&2\nexit 127\n")
    path.chmod(0o755)
    return path


def lacking(path: Path, command: str) -> list[str]:
    """Return the command of an agent that supports all commands on its control socket except this one."""
    path.write_text(LACKING.format(command=command))
    return [sys.executable, str(path)]
