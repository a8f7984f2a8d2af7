"""Test that a breakpoint in a handler stops a replay with the agent's real state, in pdb and in an IDE."""

import socket
import subprocess
import sys
from pathlib import Path

import pytest

from harness.field.replay import RecordPlayer, open_record
from tests.harness.command import DEADLINE_S
from tests.harness.field.dap import Ide
from tests.harness.field.flights import flown, trace_of
from ucp import reconcile

SOURCE = Path(reconcile.__file__).resolve()
LINE = next(
    number
    for number, text in enumerate(SOURCE.read_text().splitlines(), 1)
    if "core.majority_response_block_hash = majority_response" in text
)
"""A line of Algorithm 15. When it runs, phase 2 has chosen a block."""


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trace_of(flown(tmp_path_factory.mktemp("flight") / "run", duration_s=900), 2)


@pytest.fixture(scope="module")
def expected(record: Path) -> tuple[float, int]:
    """Return the mission second at which the agent first reaches the line, and the length of its chain at this time."""
    player = RecordPlayer(open_record(record))
    while not player.at_end:
        entry = player.forward()
        if getattr(entry.content, "branch", "") in ("block", "tie: block"):
            return player.state.now, len(player.state.chain)
    raise AssertionError("no mission of this loss is without a reconcile")


def pdb(commands: list[str], *arguments: object) -> str:
    ended = subprocess.run(
        [sys.executable, *map(str, arguments)],
        input="\n".join(commands) + "\n",
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
    )
    return ended.stdout + ended.stderr


def test_pdb_stops_in_a_handler_with_the_agent_state(record: Path, expected: tuple[float, int]) -> None:
    said = pdb(
        [f"break {SOURCE}:{LINE}", "continue", "p (core.now, len(core.chain), core.agent_id)", "quit"],
        *("-m", "pdb", "-m", "harness.cli", "replay", record),
    )
    assert f"{SOURCE}({LINE})reconcile_phase_2_timer_expiration()" in said
    assert str((*expected, 2)) in said


def test_replay_calls_the_debugger_directly_before_the_handler(record: Path, expected: tuple[float, int]) -> None:
    line = next(entry.line for entry in open_record(record).entries if getattr(entry.content, "algorithm", 0) == 15)
    said = pdb(
        ["step", "where", "p (core.now, len(core.chain))", "quit"],
        *("-m", "harness.cli", "replay", record, "--break", line, "--debug"),
    )
    assert "reconcile_phase_2_timer_expiration()" in said
    assert str(expected) in said


@pytest.mark.parametrize("calls_it", [False, True], ids=["a breakpoint", "--debug"])
def test_ide_stops_in_a_handler_with_the_agent_state(calls_it: bool, record: Path, expected: tuple[float, int]) -> None:
    pytest.importorskip("debugpy")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    under = ["-Xfrozen_modules=off", "-m", "debugpy", "--listen", f"127.0.0.1:{port}", "--wait-for-client"]
    line = next(entry.line for entry in open_record(record).entries if getattr(entry.content, "algorithm", 0) == 15)
    options = ["--break", str(line), "--debug"] if calls_it else []
    with subprocess.Popen(
        [sys.executable, *under, "-m", "harness.cli", "replay", str(record), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as replaying:
        try:
            ide = Ide(port)
            ide.attach({} if calls_it else {SOURCE: LINE})
            frame = ide.stopped_in()
            if calls_it:
                assert frame["name"] == "stop_and_run"
                ide.ask("stepIn", threadId=frame["thread"])
                frame = ide.stopped_in()
            assert frame["name"] == "reconcile_phase_2_timer_expiration"
            assert calls_it or frame["line"] == LINE
            assert Path(frame["source"]["path"]) == SOURCE
            assert ide.value("(core.now, len(core.chain), core.agent_id)", frame) == str((*expected, 2))
            ide.ask("setBreakpoints", source={"path": str(SOURCE)}, breakpoints=[])
            ide.ask("continue", threadId=frame["thread"])
            ide.event("terminated")
            ide.close()
            out, _ = replaying.communicate(timeout=DEADLINE_S)
            assert replaying.returncode == 0
            assert "no difference" in out.decode()
        finally:
            replaying.kill()
