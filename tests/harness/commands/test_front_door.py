"""Test the help of the command line and shell completion. Neither imports the modules of commands."""

import json
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from importlib import import_module
from importlib.metadata import version
from inspect import getdoc
from pathlib import Path
from typing import Any

import pytest
import typer

from harness.cli import COMMANDS, OLD_NAMES, load_command
from tests.harness.command import COMMAND, harness, sentences, write_scenario
from tests.harness.mission import CONNECTED, fly, write_run

IMPORTED_BY_HELP = {"harness", "harness.cli", "harness.compiled", "harness.errors", "harness.gc_pause"}


def test_help_imports_no_command() -> None:
    script = """
import sys
from typer.testing import CliRunner
from harness.cli import app
assert CliRunner().invoke(app, ["--help"]).exit_code == 0
print(*(name for name in sys.modules if name.split(".")[0] in ("harness", "ucp", "netem", "sitl", "pydantic", "scapy")))
"""
    listed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert set(listed.stdout.split()) == IMPORTED_BY_HELP


def test_commands_run_and_report_do_not_import_mavlink() -> None:
    script = """
import sys
import harness.commands.report, harness.commands.run
print(*(name for name in sys.modules if name.startswith("pymavlink")))
"""
    listed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert listed.stdout.split() == []


@pytest.mark.parametrize("name", COMMANDS)
def test_summary_of_a_command_is_the_start_of_its_help(name: str) -> None:
    _, location, summary = COMMANDS[name]
    module, _, attribute = location.partition(":")
    command = getattr(import_module(module), attribute)
    own = command.info.help if isinstance(command, typer.Typer) else getattr(command, "help", None) or getdoc(command)
    assert own is not None
    assert own.split("\n\n")[0].replace("\n", " ") == summary


def panels(*command: str) -> dict[str, str]:
    """Return the title and text of each panel of a command's help at a width of 80 columns."""
    shown = harness(*command, "--help", env={**os.environ, "COLUMNS": "80"}).stdout
    return dict(re.findall(r"╭─ ([^─]+) ─+╮\n(.*?)╰─", shown, re.DOTALL))


def test_each_command_has_one_line_in_one_panel() -> None:
    shown = panels()
    assert [*shown] == ["Options", "run", "look", "field", "many", "prove", "this machine"]
    listed = {title: re.findall(r"^│ (\S.*?) +│$", text, re.MULTILINE) for title, text in shown.items()}
    del listed["Options"]
    for name, (panel, _, summary) in COMMANDS.items():
        in_panels = [title for title, lines in listed.items() if f"{name:<11}  {summary}" in lines]
        assert in_panels == [panel], name
    assert sum(map(len, listed.values())) == len(COMMANDS)


def commands_of(command: Any, *names: str) -> Iterator[tuple[str, Any]]:
    yield " ".join(names), command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands_of(inner, *names, name)


OPTIONS_IN_A_PANEL = 11
"""Maximum number of options in a panel. The first panel of `run` has one less, without the rare options."""


@pytest.mark.parametrize("name", COMMANDS)
def test_each_option_has_one_line_of_help_and_no_panel_is_long(name: str) -> None:
    for command_name, command in commands_of(load_command(name), name):
        in_panel = Counter[str | None]()
        for parameter in command.params:
            help_text = parameter.help or ""
            assert re.fullmatch(r"[^\n]{4,67}\.", help_text), f"{command_name} {parameter.name}: {help_text!r}"
            in_panel[parameter.rich_help_panel] += 1
        assert max(in_panel.values(), default=0) <= OPTIONS_IN_A_PANEL, command_name


def test_prove_shows_rare_options_below_common_ones() -> None:
    shown = panels("prove")
    assert [*shown] == ["Options", "Rare options", "Wrong or captured agents", "Limits"]
    assert all(option in shown["Options"] for option in ("--agents", "--blocks", "--network", "--faults", "--out"))
    assert "--whole" in shown["Rare options"] and "--memory" in shown["Limits"]


@pytest.mark.parametrize("name", OLD_NAMES)
def test_old_name_of_a_command_is_refused_with_the_new_one(name: str) -> None:
    refused = harness(name, "my.yaml", "--seed", "3")
    assert refused.returncode == 128
    assert sentences(refused.stderr) == [f"`{name}` is now {OLD_NAMES[name]}: run that"]
    new = re.match(r"`ucp-harness (\w+)", OLD_NAMES[name])
    assert new is not None and new[1] in COMMANDS and name not in COMMANDS


def test_option_version_prints_the_version() -> None:
    assert harness("--version").stdout == f"ucp-harness {version('ucp-harness')}\n"


@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("ucp-harness ch", {"check", "chain"}),
        ("ucp-harness run --backe", {"--backend"}),
        ("ucp-harness sitl pa", {"path"}),
        ("ucp-harness run loss_1", {"loss_10", "loss_100", "loss_15"}),
        ("ucp-harness explore scenarios/loss_15", {"scenarios/loss_15.yaml"}),
    ],
)
def test_shell_completes_commands_and_options(typed: str, completed: set[str]) -> None:
    word = str(len(typed.split()) - 1)
    asked = {"_UCP_HARNESS_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": word}
    script = "from harness.cli import app; app(prog_name='ucp-harness')"
    answer = subprocess.run(
        [COMMAND[0], "-c", script], capture_output=True, text=True, env={**os.environ, **asked}, check=True
    )
    assert set(answer.stdout.split()) == completed


@pytest.mark.parametrize(("columns", "lines"), [(None, 1), ("80", 3)])
def test_piped_table_is_as_wide_as_its_text(tmp_path: Path, columns: str | None, lines: int) -> None:
    name = "A scenario with a name of more than eighty characters, which a terminal would wrap to several lines"
    write_run(fly(agents=3, duration_s=100), tmp_path / "runs" / "run", CONNECTED)
    record = tmp_path / "runs" / "run" / "run.json"
    document = json.loads(record.read_text())
    document["scenario"] = {"name": name}
    record.write_text(json.dumps(document))
    environment = {key: value for key, value in os.environ.items() if key != "COLUMNS"}
    printed = harness("runs", tmp_path / "runs", env=environment | ({"COLUMNS": columns} if columns else {})).stdout
    assert (name in printed) == (columns is None)
    assert len(printed.splitlines()) >= 1 + lines


@pytest.mark.parametrize("name", ["los_15", "scenarios/los_15.yaml"])
def test_misspelt_scenario_gets_a_suggestion(name: str) -> None:
    refused = harness("run", name)
    assert refused.returncode == 2
    assert refused.stderr.endswith(f"; did you mean `{name.replace('los_', 'loss_')}`?\n")


def test_unknown_command_gets_a_suggestion() -> None:
    refused = harness("chek")
    assert refused.returncode == 2
    assert "Did you mean 'check'?" in refused.stderr


def test_full_standard_output_has_status_3(tmp_path: Path) -> None:
    run_dir = write_run(fly(agents=3, duration_s=400), tmp_path / "run", CONNECTED)
    for arguments in (["--help"], ["sitl", "--help"], ["check", run_dir], ["check", run_dir, "--json"]):
        with Path("/dev/full").open("w") as full:
            ended = subprocess.run(
                [*COMMAND, *map(str, arguments)], stdout=full, stderr=subprocess.PIPE, text=True, check=False
            )
        assert ended.returncode == 3
        assert sentences(ended.stderr) == ["standard output cannot be written: No space left on device"]


@pytest.mark.parametrize("options", [[], ["--json"]])
@pytest.mark.parametrize(("blocks", "status"), [(3, 0), (4, 1)])
def test_closed_standard_output_does_not_change_the_status(
    tmp_path: Path, options: list[str], blocks: int, status: int
) -> None:
    reads, writes = os.pipe()
    os.close(reads)
    bounds = ["--agents", "2", "--blocks", str(blocks), "--network", "lossless", "--out", str(tmp_path / "way.yaml")]
    ended = subprocess.run(
        [*COMMAND, "prove", *bounds, *options], stdout=writes, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writes)
    assert (ended.returncode, ended.stderr) == (status, "")


def test_run_refuses_a_scenario_that_is_no_regular_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "scenario.yaml")
    for path, why in (
        (tmp_path / "scenario.yaml", "not a file"),
        ("/dev/zero", "not a file"),
        (tmp_path, "a directory"),
    ):
        refused = harness("run", path)
        assert refused.returncode == 2
        assert sentences(refused.stderr) == [f"{path}: cannot be read: is {why}"]


def test_mission_above_the_maximum_duration_is_refused(tmp_path: Path) -> None:
    refused = harness("run", write_scenario(tmp_path, duration_s=10**9))
    assert refused.returncode == 2
    assert "`duration_s` is 1000000000: it should be less than or equal to 2678400" in refused.stderr


@pytest.mark.parametrize("command", ["check", "run", "replay"])
def test_too_long_file_name_is_refused_in_one_sentence(command: str) -> None:
    ended = harness(command, "x" * 5000)
    assert ended.returncode == 2
    (sentence,) = sentences(ended.stderr)
    assert sentence.startswith("xxx") and sentence.endswith("File name too long")
