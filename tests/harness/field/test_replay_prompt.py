"""Test the commands of an interactive replay, from a pipe and from a terminal."""

import json
import os
import pty
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from harness.field.replay import RecordPlayer, open_record
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences
from tests.harness.field.flights import flown, trace_of


@pytest.fixture(scope="module")
def wrong_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("wrong") / "run", quirks={"stale_chain_hash": True}, duration_s=900)


def output_of(wrong_run: Path, *commands: str, options: tuple[str, ...] = ("--step",)) -> dict[str, list[str]]:
    """Return the output lines after each command. The commands must be different from each other."""
    ended = harness("replay", wrong_run, "--agent", 2, *options, input="".join(f"{command}\n" for command in commands))
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


def first_difference(wrong_run: Path) -> int:
    first = RecordPlayer(open_record(wrong_run, 2)).to_end().first
    assert first is not None
    return first.line


def test_step_shows_cause_and_effects_and_state_shows_all_data(wrong_run: Path) -> None:
    said = output_of(wrong_run, "next", "state", "quit")
    assert said[""][1] == "before line 1: agent 2 as it begins"
    assert said["next"][0].startswith("line 2, t=")
    assert "Algorithm 1, build_data_block" in said["next"][0]
    assert said["next"][1].split() == ["because", "the", "vehicle", "logged", *said["next"][1].split()[4:]]
    assert [line.split()[0] for line in said["state"]] == ["chain", "deque", "stack", "current", "timers", "flags"]
    assert "1 event, " in said["state"][3]


def test_back_shows_the_previous_step_again(wrong_run: Path) -> None:
    said = output_of(wrong_run, "n 30", "s", "n 40", "back 40", "state", "b 29", "w", "q")
    assert said["back 40"] == said["n 30"]
    assert said["state"] == said["s"]
    assert said["b 29"][0] == said["w"][0] == "line 2, t=" + said["w"][0].partition("t=")[2]


def test_continue_stops_at_breakpoints_and_differences(wrong_run: Path) -> None:
    line = first_difference(wrong_run)
    said = output_of(wrong_run, "c", "compare", "reverse-continue", "next difference", "break 3", "rc", "q")
    assert said["c"][0].startswith(f"line {line},")
    assert any(row.startswith("  ✘ it had the top chain hash") for row in said["c"])
    assert any(row.startswith("top") for row in said["compare"])
    assert said["reverse-continue"][0].startswith("before line 1")
    assert said["next difference"] == said["c"]
    assert said["rc"][0].startswith("line 3,")


def test_break_option_determines_the_first_stop(wrong_run: Path) -> None:
    said = output_of(wrong_run, "q", options=("--break", "A2"))
    assert any("Algorithm 2, process_next_deque_block" in line for line in said[""])


def test_others_shows_the_other_agents_at_that_moment(wrong_run: Path) -> None:
    said = output_of(wrong_run, "n A2", "o", "n receive_vote_add_block", "others", "q")
    assert any(line.startswith("  agent 1: ") for line in said["others"])
    assert any("sent it at line " in line for line in said["others"])
    assert any("heard Block Add Request" in line for line in said["o"])


def test_missing_local_event_is_shown_with_its_step(tmp_path: Path) -> None:
    wrong_run = flown(tmp_path / "run", quirks={"give_up_unfinished": True}, duration_s=900, network={"loss": 0.4})
    line = first_difference(wrong_run)
    shown = output_of(wrong_run, "q", options=("--break", str(line)))[""]
    assert any(row.startswith("  ✘ it triggered nothing; it should have triggered Reconcile Finalize") for row in shown)
    went_on = output_of(wrong_run, "c", "rc", "next difference", "q")
    assert went_on["c"] == went_on["next difference"]
    assert went_on["rc"][0].startswith("before line 1")


def test_others_are_aligned_by_messages_if_clocks_are_wrong(tmp_path: Path) -> None:
    directory = flown(tmp_path / "run", clocks={1: {"offset_s": 120.0}, 3: {"offset_s": -30.0, "drift": 0.01}})
    late = {1: (120.0, 1.0), 3: (-30.0, 1.01)}
    for agent in (1, 2, 3):
        offset_s, rate = late.get(agent, (0.0, 1.0))
        lines = [json.loads(line) for line in trace_of(directory, agent).read_text().splitlines()]
        lines[0]["clock"] = {"epoch_us": 0, "speedup": 1}  # The clock is wrong, without any sign of it.
        for line in lines[1:]:
            line["t"] = round(offset_s + rate * line["t"], 6)
        (tmp_path / f"{agent}.trace.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    shutil.rmtree(directory)
    said = output_of(tmp_path, "n receive_vote_add_block", "others", "q")["others"]
    sending = next(number for number, row in enumerate(said) if "sent it at line" in row)
    around = next(row for row in said[sending + 1 :] if row.split()[3] == said[sending].split()[4].replace(",", ":"))
    assert -0.2 < float(around.split()[0]) < 0


def test_leaving_the_debugger_keeps_the_position(wrong_run: Path) -> None:
    ended = harness("replay", wrong_run, "--agent", 2, "--step", input="n 20\ns\ndebug\nq\ns\nb\nn\ns\nq\n")
    assert sentences(ended.stderr) == []
    first, second, third = (text.split("\n> ")[0] for text in ended.stdout.split("\n> s\n")[1:])
    assert first == second == third


@pytest.mark.parametrize(
    "options", [("--json", "--step"), ("--json", "--break", "A2"), ("--debug",), ("--break", "A99")]
)
def test_contradictory_options_are_rejected(options: tuple[str, ...], wrong_run: Path) -> None:
    ended = harness("replay", wrong_run, "--agent", 2, *options, input="")
    assert ended.returncode == 2
    assert "Traceback" not in ended.stderr


def test_impossible_command_is_reported(wrong_run: Path) -> None:
    said = output_of(wrong_run, "b", "fly", "goto x", "n nobody", "clear 7", "quit")
    assert said["b"] == ["start of the record"]
    assert said["fly"][0].startswith("'fly' is not a command")
    assert said["goto x"][0].startswith("goto needs a line")
    assert "is not a breakpoint: use a line number" in said["n nobody"][0]
    assert said["clear 7"] == ["no breakpoint at '7'"]


def test_rest_is_played_at_the_end_of_the_commands(wrong_run: Path) -> None:
    ended = harness("replay", wrong_run, "--agent", 2, "--step", input="n\n")
    assert ended.returncode == 1
    assert "the first:" in ended.stdout
    ended = harness("replay", wrong_run, "--agent", 2, "--step", input="n\nq\n")
    assert ended.returncode == 0
    assert "the first:" not in ended.stdout


def test_output_to_a_pipe_has_no_colours(wrong_run: Path) -> None:
    assert "\x1b" not in harness("replay", wrong_run, "--agent", 2, "--step", input="n 5\ns\nc\n").stdout


def test_closed_output_pipe_causes_no_error(wrong_run: Path) -> None:
    command = f"{' '.join(COMMAND)} replay {trace_of(wrong_run, 2)} --step"
    commands = "n\ns\n" * 2000
    ended = subprocess.run(
        ["bash", "-c", f"{command} | head -1"], input=commands, capture_output=True, text=True, timeout=DEADLINE_S
    )
    assert ended.stderr == ""
    assert ended.stdout.count("\n") == 1


def test_interrupt_at_the_prompt_gives_status_130(wrong_run: Path) -> None:
    ours, its = pty.openpty()
    with subprocess.Popen(
        [*COMMAND, "replay", str(trace_of(wrong_run, 2)), "--step"],
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
            os.write(ours, b"\n")  # readline misses a signal directly before it starts to wait for a key.
            assert replaying.wait(DEADLINE_S) == 130
        finally:
            replaying.kill()
            os.close(ours)
