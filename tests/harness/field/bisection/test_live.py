"""Test the replay with an agent process: a correct agent agrees with the record, and a wrong agent does not."""

import json
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from harness.errors import FieldError
from harness.field.bisection import _live_replay
from harness.field.bisection._live_replay import (
    MAX_MACHINE_DELAY_S,
    BusyMachineError,
    ReceivedMessages,
    play_live,
    script_of,
)
from harness.field.bisection._scripted_peers import AgentLateness, message_key
from harness.field.replay import open_record
from tests.harness.command import harness
from ucp.messages import ChainContainQuery, encode

PYTHON = shlex.quote(sys.executable)
RIGHT = f"{PYTHON} -P -m ucp.node"
WRONG = """import json, sys
from pathlib import Path
from ucp.node import main

path = Path(sys.argv[1])
mission = json.loads(path.read_text())
mission["quirks"]["disapprove_everything"] = True
path.write_text(json.dumps(mission))
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("field")
    scenario = path / "short.yaml"
    short = {"name": "short", "agents": 4, "duration_s": 150, "network": {"loss": 0.3}, "settle": {"limit_s": 30}}
    scenario.write_text(json.dumps({**short, "events": {"source": "random", "mean_s": 10}}))
    harness("run", scenario, "--backend", "sim", "--seed", 3, "--out", path / "run")
    shutil.copytree(path / "run/agents", path / "home")
    return path / "home"


@pytest.mark.lab
@pytest.mark.any_user
def test_only_a_correct_agent_agrees_with_the_record(records: Path, tmp_path: Path) -> None:
    options = ["--agent", 2, "--speedup", 10, "--agent-command"]
    right = harness("bisect", "--once", records, *options, RIGHT)
    assert right.returncode == 0, right.stdout + right.stderr
    assert "agent 2: as recorded" in right.stdout
    (tmp_path / "wrong.py").write_text(WRONG)
    wrong = harness("bisect", "--once", records, *options, f"{PYTHON} -P {shlex.quote(str(tmp_path / 'wrong.py'))}")
    assert wrong.returncode == 1, wrong.stdout + wrong.stderr
    assert "approve False); the record sent Block Add Response" in wrong.stdout
    none = harness("bisect", "--once", records, *options, "no-such-agent")
    assert none.returncode == 125
    ending = harness("bisect", "--once", records, *options, f"{PYTHON} -c 'raise SystemExit(3)'")
    assert ending.returncode == 125 and "the agent ended by itself with status 3" in ending.stderr


def test_script_answers_a_query_after_the_agent_sends_it(records: Path) -> None:
    script = script_of(open_record(records, 2))
    answers = [given for given in script.datagrams if given.after is not None]
    assert answers and all(given.asked_s < given.t < given.asked_s + 6 for given in answers)
    assert {question for _, question in script.questions} >= {given.after for given in answers}
    assert script.expected == sorted(script.expected, key=lambda said: said.line)


def test_record_with_unknown_names_is_rejected(records: Path, tmp_path: Path) -> None:
    (tmp_path / "2.trace.jsonl").write_text((records / "2.trace.jsonl").read_text().replace("vote_timer_", "poll_"))
    with pytest.raises(FieldError, match=r"unknown handler name 'poll_expiration', so it cannot be played; give"):
        play_live(open_record(tmp_path, 2), ["no-such-agent"], tmp_path, speedup=1.0)


@pytest.fixture
def plays(records: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[float]]:
    """A function that sets the results of the next replays. Each result contains the indexes of the messages that the
    agent did not send, and the delay of the machine. Return the speeds of the replays.
    """
    expected = script_of(open_record(records, 2)).expected

    def set_results(*results: tuple[set[int], float]) -> list[float]:
        speeds: list[float] = []

        def play(replay: _live_replay._AgentProgramReplay) -> ReceivedMessages:
            missing, delay_s = results[len(speeds)]
            speeds.append(replay._speedup)
            sent = [(each.t, each.message) for index, each in enumerate(expected) if index not in missing]
            return ReceivedMessages(sent, delay_s)

        monkeypatch.setattr(_live_replay, "_play_in_lab", play)
        return speeds

    return set_results


LATE_S = 2 * MAX_MACHINE_DELAY_S


def test_difference_is_reported_if_the_machine_is_on_time(
    records: Path, tmp_path: Path, plays: Callable[..., list[float]]
) -> None:
    speeds = plays(({0}, MAX_MACHINE_DELAY_S))
    (difference,) = play_live(open_record(records, 2), ["agent"], tmp_path, speedup=8)
    assert difference.detail.startswith("it did not send it") and speeds == [8]


@pytest.mark.parametrize("second", [(set[int](), LATE_S), (set[int](), 0.0)])
def test_replay_on_a_late_machine_is_repeated_more_slowly(
    records: Path, tmp_path: Path, plays: Callable[..., list[float]], second: tuple[set[int], float]
) -> None:
    speeds = plays(({0}, LATE_S), second)
    assert play_live(open_record(records, 2), ["agent"], tmp_path, speedup=8) == [] and speeds == [8, 4]


def test_difference_in_all_replays_on_a_late_machine_is_reported(
    records: Path, tmp_path: Path, plays: Callable[..., list[float]]
) -> None:
    speeds = plays(({0, 1}, LATE_S), ({0, 2}, LATE_S), ({0}, LATE_S))
    (difference,) = play_live(open_record(records, 2), ["agent"], tmp_path, speedup=8)
    assert difference.line == script_of(open_record(records, 2)).expected[0].line and speeds == [8, 4, 2]


def test_agent_is_not_accused_if_each_replay_on_a_late_machine_differs(
    records: Path, tmp_path: Path, plays: Callable[..., list[float]]
) -> None:
    plays(({0}, LATE_S), ({1}, LATE_S), ({2}, LATE_S))
    with pytest.raises(BusyMachineError, match=r"woke programs up to 0\.1 s late, .* give a lower --speedup"):
        play_live(open_record(records, 2), ["agent"], tmp_path, speedup=8)


def test_peers_are_delayed_while_a_late_agent_reconciles() -> None:
    lateness = AgentLateness(0.1)
    assert lateness.at(5.0) == 0.0
    lateness.note_question(10.5, [2.0, 10.0])
    assert lateness.at(14.0) == pytest.approx(0.6)
    assert lateness.at(17.0) == 0.0
    lateness.note_question(30.0, [])
    assert lateness.at(31.0) == 0.0


def test_message_key_ignores_sender_and_sequence_number() -> None:
    question = ChainContainQuery(bytes(32))
    assert (
        message_key(encode(1, 5, question))
        == message_key(encode(1, 6, question))
        == message_key(encode(2, 5, question))
    )
    assert message_key(encode(1, 5, question)) != message_key(encode(1, 5, ChainContainQuery(bytes(31) + b"x")))
