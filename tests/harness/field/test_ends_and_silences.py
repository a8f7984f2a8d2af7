"""Test records that end because an agent died in a handler. Test that messages are found that an agent ignored without
recording them.
"""

import dataclasses
import json
import re
from pathlib import Path
from random import Random
from typing import Any

import pytest

from benchmarks import field_damage
from benchmarks.field_damage import bring_home
from harness.field.replay import RecordPlayer, ReplayResult, open_record, open_records
from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.run.simulate import simulate
from tests.harness.command import harness
from tests.harness.virtual import scenario
from ucp.agent import ON_LOCAL_EVENT, ON_MESSAGE, Agent
from ucp.core import Core
from ucp.events import LoggableEvent
from ucp.messages import BlockAddRequest

FLIGHT: dict[str, Any] = {"agents": 3, "duration_s": 240, "events": {"source": "random", "mean_s": 8}, "capture": True}
DEAD = 3


def _break_algorithm_3(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the handler of Algorithm 3 raise an exception in one agent, as an edited core may do."""
    right = ON_MESSAGE[BlockAddRequest]

    def dying(core: Core, sender: int, message: BlockAddRequest) -> str:
        if core.agent_id == DEAD and core.now > 60:
            raise KeyError("no such vote")
        return right.run(core, sender, message)

    monkeypatch.setitem(ON_MESSAGE, BlockAddRequest, dataclasses.replace(right, run=dying))


@pytest.fixture
def crashed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return a directory with the run of an agent that dies in Algorithm 3. Its subdirectory `home` has the files from
    the field.
    """
    _break_algorithm_3(monkeypatch)
    bring_home(scenario(**FLIGHT), 1, "sim", tmp_path / "run", tmp_path / "home")
    return tmp_path


def test_agent_that_dies_in_a_handler_does_not_end_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    _break_algorithm_3(monkeypatch)
    simulated = simulate(scenario(**FLIGHT | {"capture": False}), 1, tracing=True)
    assert simulated.played.mission_s >= 240
    assert simulated.played.exit_status == 1
    assert simulated.played.agents["3"].outcome == "crashed"
    last_s = {agent_id: trace.runs[-1].t for agent_id, trace in simulated.evidence.traces.items()}
    assert last_s[DEAD] < 100 < 200 < min(last_s[1], last_s[2])
    steps = simulated.result.judgements["steps"]
    assert steps.verdict == "deviates"
    assert [(finding.agent_id, finding.handler) for finding in steps.evidence] == [(DEAD, "receive_request_add_block")]
    assert "its record ends here, because the handler did not finish: it crashed at " in steps.evidence[0].detail
    assert "KeyError: 'no such vote'" in steps.evidence[0].detail


def test_messages_to_a_dead_agent_are_not_lost(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The run has no loss. The agent dies at about 60 s, starts again at 120 s, and dies again."""
    _break_algorithm_3(monkeypatch)
    reboot = [{"at_s": 100, "reboot": [DEAD], "down_s": 20, "disk": "lost"}]
    flight = scenario(**FLIGHT, network={"loss": 0.0}, timeline=reboot)
    finished = run(flight, 1, tmp_path / "run", SilentProgress(), "sim")
    assert finished.result.bad == ("steps",)
    assert [failure.incarnation for failure in finished.record.agents["3"].failures] == [1, 2]
    assert finished.result.judgements["steps"].reason.startswith("2 differences")


@pytest.mark.parametrize("tracing", [True, False])
def test_agent_that_died_reboots_with_its_disk(monkeypatch: pytest.MonkeyPatch, tracing: bool) -> None:
    """The handler of Algorithm 1 completes a block and then raises an exception. The disk does not have this block."""
    right, dead = ON_LOCAL_EVENT["Build Data Block"], []

    def dying(core: Core, event: LoggableEvent) -> str:
        branch = right.run(core, event)
        if core.agent_id == DEAD and len(core.completed) == 3 and not dead:
            dead.append(list(core.completed))
            raise KeyError("no such block")
        return branch

    monkeypatch.setitem(ON_LOCAL_EVENT, "Build Data Block", dataclasses.replace(right, run=dying))
    reboot = [{"at_s": 200, "reboot": [DEAD], "down_s": 10, "disk": "kept"}]
    flight = scenario(**FLIGHT | {"capture": False, "events": {"mean_s": 3}}, timeline=reboot, network={"loss": 0.0})
    simulated = simulate(flight, 1, tracing=tracing)
    agent = simulated.played.agents["3"]
    assert (agent.outcome, agent.restarts, agent.reboots) == ("exported", 0, 1)
    *on_disk, lost = [block.hex() for block in dead[0]]
    completed = simulated.evidence.exports[DEAD].completed
    assert completed[:2] == on_disk and lost not in completed
    assert simulated.result.wrong == (("steps",) if tracing else ("ended",))


def _end_of_record(home: Path) -> ReplayResult:
    result = RecordPlayer(open_record(home, DEAD)).to_end()
    assert result.deviations == []
    assert result.unjudged == len(result.lost) == 1
    return result


def test_replay_names_the_message_at_which_the_record_ends(crashed: Path) -> None:
    sentence = _end_of_record(crashed / "home").lost[0]
    assert re.search(
        r"the record ends at line \d+, t=.* s, before Algorithm 3, receive_request_add_block, of the Block Add "
        r"Request \d+ of agent \d, which reached the vehicle at t=.* s; the handler did not finish, or the agent had "
        r"ended",
        sentence,
    ), sentence
    for capture in (crashed / "home").glob("*.pcapng"):
        capture.unlink()
    without_capture = _end_of_record(crashed / "home").lost[0]
    assert re.search(r"the Block Add Request \d+ that agent \d sent at t=.* s; it was lost, or the", without_capture)
    replayed = harness("replay", crashed / "home", "--agent", DEAD)
    assert replayed.returncode == 0
    assert "all follow Algorithms 1 to 20" not in replayed.stdout
    checked = harness("check", crashed / "home", "--json")
    assert json.loads(checked.stdout)["steps"]["verdict"] == "not applicable"


def test_replay_names_the_timer_at_which_the_record_ends(crashed: Path) -> None:
    """The record of agent 1 ends while its vote timer runs. Other agents' records lack the lines of this time."""
    home = crashed / "home"
    (home / "3.trace.jsonl").unlink()
    (home / "1.chain.json").unlink()
    (home / "1.pcapng").unlink()
    header, *lines = (home / "1.trace.jsonl").read_text().splitlines(keepends=True)
    asked = next(number for number, line in enumerate(lines) if '"voting":10' in line)
    (home / "1.trace.jsonl").write_text("".join([header, *lines[: asked + 1]]))
    header, *lines = (home / "2.trace.jsonl").read_text().splitlines(keepends=True)
    (home / "2.trace.jsonl").write_text("".join([header, *lines[len(lines) // 2 :]]))
    sentence = RecordPlayer(open_record(home, 1)).to_end().lost[-1]
    assert "before Algorithm 5, vote_timer_expiration, of the voting timer due at t=" in sentence


def test_silently_ignored_messages_are_found_in_a_capture(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    right = Agent.receive_message

    def receive(agent: Agent, sender: int, sequence: int, message: Any, now: float, datagram: Any = None) -> None:
        if agent.agent_id != 2 or not isinstance(message, BlockAddRequest):
            right(agent, sender, sequence, message, now, datagram)

    bring_home(scenario(**FLIGHT), 1, "sim", tmp_path / "run", tmp_path / "right")
    assert RecordPlayer(open_record(tmp_path / "right", 2)).to_end().deviations == []
    monkeypatch.setattr(Agent, "receive_message", receive)
    bring_home(scenario(**FLIGHT), 1, "sim", tmp_path / "wrong", tmp_path / "home")
    first = RecordPlayer(open_record(tmp_path / "home", 2)).to_end().first
    assert first is not None
    assert first.handler == "receive_request_add_block"
    assert re.search(
        r"it did not run for the Block Add Request \d+ of agent \d, which reached its vehicle at t=.* s; messages that "
        r"reached the vehicle are missing at \d+ places",
        first.what,
    ), first.what
    for capture in (tmp_path / "home").glob("*.pcapng"):
        capture.unlink()
    assert RecordPlayer(open_record(tmp_path / "home", 2)).to_end().deviations == []


@pytest.mark.parametrize("number", [0, 14, 16, 34])
def test_agent_is_not_accused_if_its_clock_was_set_forward(tmp_path: Path, number: int) -> None:
    """A timer runs while the clock is set. The records of the other agents show the change of the clock, or the agent
    handles the timer with its next line.
    """
    flight, home = field_damage.scenario(number, "sim"), tmp_path / "home"
    bring_home(flight, number, "sim", tmp_path / "run", home)
    field_damage.set_clock_forward(home, Random(f"{number} clock set forward"))
    for record in open_records(home):
        assert RecordPlayer(record).to_end().deviations == []
    judged = json.loads(harness("check", home, "--json").stdout)
    assert {"violated", "deviates"}.isdisjoint(json.dumps(judged).split('"'))


def test_clock_set_back_is_no_ignored_message(tmp_path: Path) -> None:
    """Messages without an effect have no line in a simulated trace. If the clock of the trace is wrong, they must not
    count as ignored.
    """
    flight, home = field_damage.scenario(9, "sim"), tmp_path / "home"
    bring_home(flight, 9, "sim", tmp_path / "run", home)
    field_damage.set_clock_back(home, Random("9 clock set back"))
    assert RecordPlayer(open_record(home, 1)).to_end().deviations == []
