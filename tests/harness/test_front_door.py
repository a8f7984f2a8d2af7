"""The command line opens at once: it lists its commands without importing them, and completes what is typed."""

import os
import subprocess
import sys
from importlib import import_module
from importlib.metadata import version
from inspect import getdoc

import pytest
import typer

from harness.cli import COMMANDS
from tests.harness.command import COMMAND, harness

ITS_OWN = {"harness", "harness.cli", "harness.errors"}


def test_help_imports_no_command() -> None:
    script = """
import sys
from typer.testing import CliRunner
from harness.cli import app
assert CliRunner().invoke(app, ["--help"]).exit_code == 0
print(*(name for name in sys.modules if name.split(".")[0] in ("harness", "ucp", "netem", "sitl", "pydantic", "scapy")))
"""
    listed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert set(listed.stdout.split()) == ITS_OWN


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_says_what_a_commands_own_help_says(name: str) -> None:
    where, summary = COMMANDS[name]
    module, _, attribute = where.partition(":")
    command = getattr(import_module(module), attribute)
    own = command.info.help if isinstance(command, typer.Typer) else getdoc(command)
    assert own is not None
    assert own.split("\n\n")[0].replace("\n", " ") == summary


def test_version() -> None:
    assert harness("--version").stdout == f"ucp-harness {version('ucp-harness')}\n"


@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("ucp-harness ch", {"check", "chain"}),
        ("ucp-harness run --backe", {"--backend"}),
        ("ucp-harness sitl pa", {"path"}),
    ],
)
def test_what_is_typed_is_completed(typed: str, completed: set[str]) -> None:
    word = str(len(typed.split()) - 1)
    asked = {"_UCP_HARNESS_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": word}
    script = "from harness.cli import app; app(prog_name='ucp-harness')"
    answer = subprocess.run(
        [COMMAND[0], "-c", script], capture_output=True, text=True, env={**os.environ, **asked}, check=True
    )
    assert set(answer.stdout.split()) == completed


def test_a_command_that_there_is_not_is_told_from_those_that_there_are() -> None:
    refused = harness("chek")
    assert refused.returncode == 2
    assert "Did you mean 'check'?" in refused.stderr
