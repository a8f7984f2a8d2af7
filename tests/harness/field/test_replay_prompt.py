"""Stepping through a record: the commands, as a user pipes them in or types them."""

import os
import pty
import signal
import subprocess
import time
from pathlib import Path

import pytest

from harness.field.replay import Player, open_record
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences
from tests.harness.field.flights import flown, trace_of


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("wrong") / "run", quirks={"stale_chain_hash": True}, duration_s=900)


def told(wrong: Path, *commands: str, options: tuple[str, ...] = ("--step",)) -> dict[str, list[str]]:
    """What was printed after each command, which are all different."""
    ended = harness("replay", wrong, "--agent", 2, *options, input="".join(f"{command}\n" for command in commands))
    assert sentences(ended.stderr) == []
    said: dict[str, list[str]] = {"": []}
    last = ""
    for line in ended.stdout.splitlines():
        if line.startswith("> "):
            last = line.removeprefix("> ")
            said[last] = []
        else:
            said[last].append(line)
    return said


def first_difference(wrong: Path) -> int:
    first = Player(open_record(wrong, 2)).to_end().first
    assert first is not None
    return first.line


def test_a_step_says_why_and_what_came_of_it_and_the_state_what_is_held(wrong: Path) -> None:
    said = told(wrong, "next", "state", "quit")
    assert said[""][1] == "before line 1: agent 2 as it begins"
    assert said["next"][0].startswith("line 2, t=")
    assert "Algorithm 1, build_data_block" in said["next"][0]
    assert said["next"][1].split() == ["because", "the", "vehicle", "logged", *said["next"][1].split()[4:]]
    assert [line.split()[0] for line in said["state"]] == ["chain", "deque", "stack", "current", "timers", "flags"]
    assert "1 event, " in said["state"][3]


def test_back_shows_what_was_shown_before(wrong: Path) -> None:
    said = told(wrong, "n 30", "s", "n 40", "back 40", "state", "b 29", "w", "q")
    assert said["back 40"] == said["n 30"]
    assert said["state"] == said["s"]
    assert said["b 29"][0] == said["w"][0] == "line 2, t=" + said["w"][0].partition("t=")[2]


def test_breaks_and_differences_stop(wrong: Path) -> None:
    line = first_difference(wrong)
    said = told(wrong, "c", "compare", "reverse-continue", "next difference", "break 3", "rc", "q")
    assert said["c"][0].startswith(f"line {line},")
    assert any(row.startswith("  ✘ it had the top chain hash") for row in said["c"])
    assert any(row.startswith("top") for row in said["compare"])
    assert said["reverse-continue"][0].startswith("before line 1")
    assert said["next difference"] == said["c"]
    assert said["rc"][0].startswith("line 3,")


def test_a_break_is_where_it_stops_first(wrong: Path) -> None:
    said = told(wrong, "q", options=("--break", "A2"))
    assert any("Algorithm 2, process_next_deque_block" in line for line in said[""])


def test_the_others_are_shown_as_they_were_at_that_moment(wrong: Path) -> None:
    said = told(wrong, "n A2", "o", "n receive_vote_add_block", "others", "q")
    assert any(line.startswith("  agent 1: ") for line in said["others"])
    assert any("sent it at line " in line for line in said["others"])
    assert any("heard Block Add Request" in line for line in said["o"])


def test_what_cannot_be_done_is_said(wrong: Path) -> None:
    said = told(wrong, "b", "fly", "goto x", "n nobody", "clear 7", "quit")
    assert said["b"] == ["this is the start"]
    assert said["fly"][0].startswith("there is no command 'fly'")
    assert said["goto x"][0].startswith("goto wants a line")
    assert "is no place to stop at" in said["n nobody"][0]
    assert said["clear 7"] == ["there is no break at '7'"]


def test_when_the_commands_end_the_rest_is_played(wrong: Path) -> None:
    ended = harness("replay", wrong, "--agent", 2, "--step", input="n\n")
    assert ended.returncode == 1
    assert "the first:" in ended.stdout
    ended = harness("replay", wrong, "--agent", 2, "--step", input="n\nq\n")
    assert ended.returncode == 0
    assert "the first:" not in ended.stdout


def test_no_colours_in_a_pipe(wrong: Path) -> None:
    assert "\x1b" not in harness("replay", wrong, "--agent", 2, "--step", input="n 5\ns\nc\n").stdout


def test_a_reader_that_has_seen_enough_ends_it_quietly(wrong: Path) -> None:
    command = f"{' '.join(COMMAND)} replay {trace_of(wrong, 2)} --step"
    commands = "n\ns\n" * 2000
    ended = subprocess.run(
        ["bash", "-c", f"{command} | head -1"], input=commands, capture_output=True, text=True, timeout=DEADLINE_S
    )
    assert ended.stderr == ""
    assert ended.stdout.count("\n") == 1


def test_ctrl_c_at_the_prompt_is_130(wrong: Path) -> None:
    ours, its = pty.openpty()
    with subprocess.Popen(
        [*COMMAND, "replay", str(trace_of(wrong, 2)), "--step"],
        stdin=its,
        stdout=its,
        stderr=its,
        start_new_session=True,
    ) as replaying:
        os.close(its)
        said = b""
        deadline = time.monotonic() + DEADLINE_S
        while b"(replay 0/" not in said:
            assert time.monotonic() < deadline, said
            said += os.read(ours, 4096)
        replaying.send_signal(signal.SIGINT)
        try:
            os.write(ours, b"\n")  # readline looks for signals at a key, if one came right before it began to wait
            assert replaying.wait(DEADLINE_S) == 130
        finally:
            replaying.kill()
            os.close(ours)
