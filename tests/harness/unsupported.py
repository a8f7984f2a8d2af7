"""Agents that say that something is not supported, at their start or half way."""

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
    """A program that ends with 127, with these words on standard error."""
    path.write_text(f"#!/bin/sh\necho {shlex.quote(words)} >&2\nexit 127\n")
    path.chmod(0o755)
    return path


def lacking(path: Path, command: str) -> list[str]:
    """What starts an agent that has all commands of the control socket but this one."""
    path.write_text(LACKING.format(command=command))
    return [sys.executable, str(path)]
