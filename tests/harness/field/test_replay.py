"""Test the replay of records: it finds differences, goes back to exact earlier states, and refuses unusable records."""

import json
import shutil
import subprocess
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from harness import checker
from harness.archive.archive import RunArchive
from harness.checker import steps
from harness.errors import FieldError
from harness.field.replay import RecordPlayer, open_record
from harness.field.replay import _player as player_module
from harness.field.replay.breakpoints import next_stop, parse_breakpoint, source_of
from harness.field.replay.replay_names import ReplayNames
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences
from tests.harness.field.flights import flown, trace_of
from ucp.agent import HANDLERS
from ucp.quirks import QUIRKS
from ucp.trace import HandlerRun

REPOSITORY = Path(__file__).parents[3]
SLOW_VOTES = {"vote_timeout_s": 150}


@pytest.fixture(scope="module")
def correct_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("right") / "run")


@pytest.fixture(scope="module")
def wrong_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("wrong") / "run", quirks={"stale_chain_hash": True}, duration_s=900)


def state_of(player: RecordPlayer) -> Any:
    """Return the state of the reference and the result so far, in a form that tests can compare."""
    state = {name: value for name, value in vars(player.state).items() if "timer" not in name and name != "running"}
    state["chain"] = (player.state.chain.top_chain_hash, list(player.state.chain))
    state.pop("_moved")
    timers = [(timer.name, timer.deadline, timer.active) for timer in player.state.timers]
    return deepcopy(state), timers, player.result.copy()


def test_correct_agent_agrees_with_the_reference(correct_run: Path) -> None:
    for agent in (1, 2, 3):
        ended = harness("replay", correct_run, "--agent", agent)
        assert ended.returncode == 0, ended.stdout
        assert "✔ no difference: " in ended.stdout
        assert sentences(ended.stderr) == []


def test_replay_prints_a_remark_on_the_files_once(correct_run: Path, tmp_path: Path) -> None:
    for agent in (1, 2, 3):
        shutil.copy(trace_of(correct_run, agent), tmp_path)
    (tmp_path / "notes.jsonl").write_text("wind from the west\n")
    ended = harness("replay", tmp_path)
    assert ended.returncode == 0
    assert ended.stdout.count("no difference") == 3
    assert ended.stderr.count("notes.jsonl") == 1


def test_first_difference_names_handler_and_source_line(wrong_run: Path) -> None:
    ended = harness("replay", trace_of(wrong_run, 2))
    assert ended.returncode == 1
    assert "the first:" in ended.stdout
    assert "Algorithm 18, receive_response_block_for_hash (" in ended.stdout
    assert "it had the top chain hash" in ended.stdout


def test_agent_switched_off_during_a_vote_has_no_difference(tmp_path: Path) -> None:
    run = flown(tmp_path / "run", timeline=[{"at_s": 200, "switch_off": [1, 2]}], settings=SLOW_VOTES)
    ends = [json.loads(trace_of(run, agent).read_text().splitlines()[-1])["state"] for agent in (1, 2)]
    assert not all(state["idle"] for state in ends)
    for agent in (1, 2):
        ended = harness("replay", run, "--agent", agent)
        assert ended.returncode == 0, ended.stdout


@pytest.mark.parametrize(
    "quirk", ["stale_chain_hash", "give_up_unfinished", "commit_others_twice", "leave_flag_set", "hasty_vote"]
)
def test_replay_finds_the_same_deviations_as_the_checker(quirk: str, tmp_path: Path) -> None:
    directory = flown(tmp_path / "run", quirks={quirk: True}, duration_s=900, network={"loss": 0.4})
    judgement = steps.check(checker.gather(RunArchive(directory)))
    players = {agent: RecordPlayer(open_record(directory, agent)) for agent in (1, 2, 3)}
    deviations = [deviation for player in players.values() for deviation in player.to_end().deviations]
    first = min(deviations, key=lambda deviation: (deviation.t, deviation.agent_id, deviation.line))
    assert judgement.evidence[0].agent_id == first.agent_id
    assert judgement.evidence[0].detail.startswith(f"trace line {first.line}, t={first.t:g} s: ")
    assert judgement.reason.startswith(f"{len(deviations)} difference")
    assert first.handler is not None
    assert HANDLERS[first.handler].algorithm in QUIRKS[quirk].algorithms


@pytest.mark.parametrize("options", ["", "--json", "--step"])
def test_closed_output_does_not_change_the_verdict(options: str, correct_run: Path, wrong_run: Path) -> None:
    for directory, status in ((correct_run, 0), (wrong_run, 1)):
        command = f"{' '.join(COMMAND)} replay {trace_of(directory, 2)} {options} </dev/null >&-"
        ended = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=DEADLINE_S)
        assert (ended.returncode, ended.stderr) == (status, "")


def test_json_output_agrees_with_the_text(wrong_run: Path) -> None:
    ended = harness("replay", wrong_run, "--agent", 2, "--json")
    (document,) = json.loads(ended.stdout)["records"]
    assert (ended.returncode, document["verdict"], document["agent_id"]) == (1, "deviates", 2)
    first = document["differences"][0]
    assert (first["handler"], first["algorithm"]) == ("receive_response_block_for_hash", 18)
    assert first["source"] == source_of("receive_response_block_for_hash")
    assert document["steps"] + len(document["unjudged_because"]) > 100


def test_source_line_of_each_handler_is_its_first_statement() -> None:
    """Compare the source line with the first statement of each handler. A breakpoint at the line of `def` would stop
    during the import.
    """
    for name in HANDLERS:
        path, _, line = source_of(name).rpartition(":")
        lines = (Path.cwd() / path).read_text().splitlines()
        before = "\n".join(lines[: int(line) - 1])
        assert before[before.rindex("\ndef ") :].startswith(f"\ndef {name}(")
        assert before.endswith('"""')
        assert lines[int(line) - 1].startswith("    ")


@pytest.mark.parametrize("mission", ["correct_run", "wrong_run"])
def test_going_back_restores_the_exact_state(
    mission: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(player_module, "CHECKPOINT_STEPS", 50)
    record = open_record(request.getfixturevalue(mission), 2)
    player = RecordPlayer(record)
    seen = [state_of(player)]
    while not player.at_end:
        player.forward()
        seen.append(state_of(player))
    last = len(seen) - 1
    for position in (*range(last, max(last - 120, 0), -1), 0, last, last // 2, last // 2 - 1, 1):
        player.to(position)
        assert state_of(player) == seen[position], position


def test_until_option_limits_the_played_entries(wrong_run: Path) -> None:
    record = open_record(wrong_run, 2)
    first = RecordPlayer(record).to_end().first
    assert first is not None
    before = RecordPlayer(record, first.t - 0.001)
    assert before.to_end().deviations == []
    assert before.entries[-1].content.t < first.t <= record.entries[len(before.entries)].content.t


def test_breakpoints_are_lines_handlers_algorithms_or_blocks(correct_run: Path) -> None:
    record = open_record(correct_run, 1)
    player, names = RecordPlayer(record), ReplayNames(record)
    by_name = next_stop(player, parse_breakpoint("vote_timer_expiration", names))
    assert by_name == next_stop(player, parse_breakpoint("A5", names))
    assert by_name is not None
    player.to(by_name)
    assert isinstance(player.entry.content, HandlerRun) and player.entry.content.handler == "vote_timer_expiration"
    assert next_stop(player, parse_breakpoint(str(player.entry.line), names)) is None
    player.to(by_name + 1)
    assert next_stop(player, parse_breakpoint("a5", names), backward=True) == by_name
    player.to(0)
    block = next(hash_ for run in record.trace.runs for operation, hash_ in run.changes if operation == "complete")
    assert names.of(block) == "1.1"
    assert (
        next_stop(player, parse_breakpoint("1.1", names))
        == next_stop(player, parse_breakpoint(block[:10], names))
        is not None
    )


@pytest.mark.parametrize("words", ["vote_timer_expired", "A21", "", "0.0.0", "nothing at all"])
def test_invalid_breakpoint_is_rejected(words: str, correct_run: Path) -> None:
    with pytest.raises(FieldError, match="is not a breakpoint: use a line number"):
        parse_breakpoint(words, ReplayNames(open_record(correct_run, 1)))


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.trace.jsonl", "", "it is empty"),
        ("a.trace.jsonl", "no trace\n", "no trace here can be played"),
        ("a.chain.json", "{}", "no trace here can be played"),
        ("a.trace.jsonl", None, "does not exist"),
    ],
)
def test_unplayable_record_gives_one_sentence_and_status_2(
    name: str, content: str | None, sentence: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    ended = harness("replay", tmp_path / name)
    assert ended.returncode == 2
    (said,) = sentences(ended.stderr)
    assert sentence in said


def test_directory_is_played_completely_but_stepping_needs_an_agent(
    correct_run: Path, wrong_run: Path, tmp_path: Path
) -> None:
    ended = harness("replay", correct_run)
    assert ended.returncode == 0
    assert ended.stdout.count("✔ no difference: ") == 3
    for agent in (1, 2, 3):
        shutil.copy(trace_of(correct_run if agent == 3 else wrong_run, agent), tmp_path)
    ended = harness("replay", tmp_path, "--json")
    assert ended.returncode == 1
    documents = json.loads(ended.stdout)["records"]
    assert [document["agent_id"] for document in documents] == [1, 2, 3]
    ended = harness("replay", correct_run, "--step", input="")
    assert (ended.returncode, sentences(ended.stderr)) == (
        2,
        [f"{correct_run}: several records: choose one with --agent: 1, 2, 3"],
    )
    assert harness("replay", correct_run, "--agent", 9).returncode == 2
