"""Stepping through a record: the commands, as a user pipes them in or types them."""

import json
import os
import pty
import shutil
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


def test_what_a_step_failed_to_trigger_is_shown_with_that_step(tmp_path: Path) -> None:
    wrong = flown(tmp_path / "run", quirks={"give_up_unfinished": True}, duration_s=900, network={"loss": 0.4})
    line = first_difference(wrong)
    shown = told(wrong, "q", options=("--break", str(line)))[""]
    assert any(row.startswith("  ✘ it triggered nothing; it should have triggered Reconcile Finalize") for row in shown)
    went_on = told(wrong, "c", "rc", "next difference", "q")
    assert went_on["c"] == went_on["next difference"]
    assert went_on["rc"][0].startswith("before line 1")


def test_the_others_are_found_by_the_messages_where_clocks_are_wrong(tmp_path: Path) -> None:
    directory = flown(tmp_path / "run", clocks={1: {"offset_s": 120.0}, 3: {"offset_s": -30.0, "drift": 0.01}})
    late = {1: (120.0, 1.0), 3: (-30.0, 1.01)}
    for agent in (1, 2, 3):
        offset_s, rate = late.get(agent, (0.0, 1.0))
        lines = [json.loads(line) for line in trace_of(directory, agent).read_text().splitlines()]
        lines[0]["clock"] = {"epoch_us": 0, "speedup": 1}  # the clock is wrong, and nobody knows
        for line in lines[1:]:
            line["t"] = round(offset_s + rate * line["t"], 6)
        (tmp_path / f"{agent}.trace.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    shutil.rmtree(directory)
    said = told(tmp_path, "n receive_vote_add_block", "others", "q")["others"]
    sending = next(number for number, row in enumerate(said) if "sent it at line" in row)
    around = next(row for row in said[sending + 1 :] if row.split()[3] == said[sending].split()[4].replace(",", ":"))
    assert -0.2 < float(around.split()[0]) < 0


def test_leaving_the_debugger_leaves_the_record_as_it_was(wrong: Path) -> None:
    ended = harness("replay", wrong, "--agent", 2, "--step", input="n 20\ns\ndebug\nq\ns\nb\nn\ns\nq\n")
    assert sentences(ended.stderr) == []
    first, second, third = (text.split("\n> ")[0] for text in ended.stdout.split("\n> s\n")[1:])
    assert first == second == third


@pytest.mark.parametrize(
    "options", [("--json", "--step"), ("--json", "--break", "A2"), ("--debug",), ("--break", "A99")]
)
def test_what_makes_no_sense_together_is_refused(options: tuple[str, ...], wrong: Path) -> None:
    ended = harness("replay", wrong, "--agent", 2, *options, input="")
    assert ended.returncode == 2
    assert "Traceback" not in ended.stderr


def test_what_cannot_be_done_is_said(wrong: Path) -> None:
    said = told(wrong, "b", "fly", "goto x", "n nobody", "clear 7", "quit")
    assert said["b"] == ["start of the record"]
    assert said["fly"][0].startswith("no command 'fly'")
    assert said["goto x"][0].startswith("goto needs a line")
    assert "is not a breakpoint: use a line number" in said["n nobody"][0]
    assert said["clear 7"] == ["no breakpoint at '7'"]


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
