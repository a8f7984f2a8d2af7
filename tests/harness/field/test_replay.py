"""A record played again: what it finds, that it goes back exactly, and what it makes of what is broken."""

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
from harness.field.replay import Player, open_record
from harness.field.replay import _player as player_module
from harness.field.replay.breakpoints import next_place, place, source_of
from harness.field.replay.replay_names import Names
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences
from tests.harness.field.flights import flown, trace_of
from ucp.agent import HANDLERS
from ucp.quirks import QUIRKS
from ucp.trace import HandlerRun

REPOSITORY = Path(__file__).parents[3]
SLOW_VOTES = {"vote_timeout_s": 150}


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("right") / "run")


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("wrong") / "run", quirks={"stale_chain_hash": True}, duration_s=900)


def held(player: Player) -> Any:
    """All that the reference holds and has found, to compare."""
    state = {name: value for name, value in vars(player.state).items() if "timer" not in name and name != "running"}
    state["chain"] = (player.state.chain.top_chain_hash, list(player.state.chain))
    state.pop("_moved")
    timers = [(timer.name, timer.deadline, timer.active) for timer in player.state.timers]
    return deepcopy(state), timers, player.found.copy()


def test_what_a_right_agent_did_is_what_the_reference_does(right: Path) -> None:
    for agent in (1, 2, 3):
        ended = harness("replay", right, "--agent", agent)
        assert ended.returncode == 0, ended.stdout
        assert "✔ no difference: " in ended.stdout
        assert sentences(ended.stderr) == []


def test_the_first_difference_is_shown_with_its_handler_and_where_its_code_is(wrong: Path) -> None:
    ended = harness("replay", trace_of(wrong, 2))
    assert ended.returncode == 1
    assert "the first:" in ended.stdout
    assert "Algorithm 18, receive_response_block_for_hash (" in ended.stdout
    assert "it had the top chain hash" in ended.stdout


def test_whoever_was_switched_off_in_the_middle_of_a_vote_owes_no_more(tmp_path: Path) -> None:
    run = flown(tmp_path / "run", timeline=[{"at_s": 200, "switch_off": [1, 2]}], settings=SLOW_VOTES)
    ends = [json.loads(trace_of(run, agent).read_text().splitlines()[-1])["state"] for agent in (1, 2)]
    assert not all(state["idle"] for state in ends)
    for agent in (1, 2):
        ended = harness("replay", run, "--agent", agent)
        assert ended.returncode == 0, ended.stdout


@pytest.mark.parametrize(
    "quirk", ["stale_chain_hash", "give_up_unfinished", "commit_others_twice", "leave_flag_set", "hasty_vote"]
)
def test_it_finds_what_the_judge_of_a_run_finds(quirk: str, tmp_path: Path) -> None:
    directory = flown(tmp_path / "run", quirks={quirk: True}, duration_s=900, network={"loss": 0.4})
    judgement = steps.check(checker.gather(RunArchive(directory)))
    players = {agent: Player(open_record(directory, agent)) for agent in (1, 2, 3)}
    deviations = [deviation for player in players.values() for deviation in player.to_end().deviations]
    first = min(deviations, key=lambda deviation: (deviation.t, deviation.agent_id, deviation.line))
    assert judgement.evidence[0].agent_id == first.agent_id
    assert judgement.evidence[0].detail.startswith(f"trace line {first.line}, t={first.t:g} s: ")
    assert judgement.reason.startswith(f"{len(deviations)} difference")
    assert first.handler is not None
    assert HANDLERS[first.handler].algorithm in QUIRKS[quirk].algorithms


@pytest.mark.parametrize("options", ["", "--json", "--step"])
def test_a_closed_standard_output_is_no_verdict(options: str, right: Path, wrong: Path) -> None:
    for directory, status in ((right, 0), (wrong, 1)):
        command = f"{' '.join(COMMAND)} replay {trace_of(directory, 2)} {options} </dev/null >&-"
        ended = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=DEADLINE_S)
        assert (ended.returncode, ended.stderr) == (status, "")


def test_programs_are_told_the_same(wrong: Path) -> None:
    ended = harness("replay", wrong, "--agent", 2, "--json")
    (document,) = json.loads(ended.stdout)["records"]
    assert (ended.returncode, document["verdict"], document["agent_id"]) == (1, "deviates", 2)
    first = document["differences"][0]
    assert (first["handler"], first["algorithm"]) == ("receive_response_block_for_hash", 18)
    assert first["source"] == source_of("receive_response_block_for_hash")
    assert document["steps"] + len(document["unjudged_because"]) > 100


def test_every_handler_is_where_it_is_said_to_be() -> None:
    """At its first statement: a breakpoint at its `def` stops when the module is imported."""
    for name in HANDLERS:
        path, _, line = source_of(name).rpartition(":")
        lines = (Path.cwd() / path).read_text().splitlines()
        before = "\n".join(lines[: int(line) - 1])
        assert before[before.rindex("\ndef ") :].startswith(f"\ndef {name}(")
        assert before.endswith('"""')
        assert lines[int(line) - 1].startswith("    ")


@pytest.mark.parametrize("mission", ["right", "wrong"])
def test_going_back_is_exact(mission: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(player_module, "CHECKPOINT_STEPS", 50)
    record = open_record(request.getfixturevalue(mission), 2)
    player = Player(record)
    seen = [held(player)]
    while not player.at_end:
        player.forward()
        seen.append(held(player))
    last = len(seen) - 1
    for position in (*range(last, max(last - 120, 0), -1), 0, last, last // 2, last // 2 - 1, 1):
        player.to(position)
        assert held(player) == seen[position], position


def test_until_a_second_nothing_later_is_played(wrong: Path) -> None:
    record = open_record(wrong, 2)
    first = Player(record).to_end().first
    assert first is not None
    before = Player(record, first.t - 0.001)
    assert before.to_end().deviations == []
    assert before.entries[-1].what.t < first.t <= record.entries[len(before.entries)].what.t


def test_places_are_lines_handlers_algorithms_and_blocks(right: Path) -> None:
    record = open_record(right, 1)
    player, names = Player(record), Names(record)
    by_name = next_place(player, place("vote_timer_expiration", names))
    assert by_name == next_place(player, place("A5", names))
    assert by_name is not None
    player.to(by_name)
    assert isinstance(player.entry.what, HandlerRun) and player.entry.what.handler == "vote_timer_expiration"
    assert next_place(player, place(str(player.entry.line), names)) is None
    player.to(by_name + 1)
    assert next_place(player, place("a5", names), backward=True) == by_name
    player.to(0)
    block = next(hash_ for run in record.trace.runs for operation, hash_ in run.changes if operation == "complete")
    assert names.of(block) == "1.1"
    assert next_place(player, place("1.1", names)) == next_place(player, place(block[:10], names)) is not None


@pytest.mark.parametrize("words", ["vote_timer_expired", "A21", "", "0.0.0", "nothing at all"])
def test_what_is_no_place_is_said_to_be_none(words: str, right: Path) -> None:
    with pytest.raises(FieldError, match="is not a breakpoint: use a line number"):
        place(words, Names(open_record(right, 1)))


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.trace.jsonl", "", "it is empty"),
        ("a.trace.jsonl", "no trace\n", "no trace here can be played"),
        ("a.chain.json", "{}", "no trace here can be played"),
        ("a.trace.jsonl", None, "does not exist"),
    ],
)
def test_what_cannot_be_played_is_one_sentence_and_status_2(
    name: str, content: str | None, sentence: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    ended = harness("replay", tmp_path / name)
    assert ended.returncode == 2
    (said,) = sentences(ended.stderr)
    assert sentence in said


def test_all_records_of_a_directory_are_played_and_to_step_through_one_it_has_to_be_named(
    right: Path, wrong: Path, tmp_path: Path
) -> None:
    ended = harness("replay", right)
    assert ended.returncode == 0
    assert ended.stdout.count("✔ no difference: ") == 3
    for agent in (1, 2, 3):
        shutil.copy(trace_of(right if agent == 3 else wrong, agent), tmp_path)
    ended = harness("replay", tmp_path, "--json")
    assert ended.returncode == 1
    documents = json.loads(ended.stdout)["records"]
    assert [document["agent_id"] for document in documents] == [1, 2, 3]
    ended = harness("replay", right, "--step", input="")
    assert (ended.returncode, sentences(ended.stderr)) == (
        2,
        [f"{right}: several records: choose one with --agent: 1, 2, 3"],
    )
    assert harness("replay", right, "--agent", 9).returncode == 2
