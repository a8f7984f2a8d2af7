"""Test the requests of a user to an active run."""

import asyncio
import json
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from harness.errors import ScenarioError
from harness.play.interventions import Interventions
from harness.play.progress import SilentProgress
from harness.play.request_socket import SOCKET
from harness.run.run import Run, run
from harness.scenario import Scenario, load_scenario
from tests.harness.virtual import scenario

TIMEOUT_S = 60.0

pytestmark = pytest.mark.any_user


def played(asked: Scenario, out: Path, do: Callable[[Interventions], None]) -> Run:
    """Play a simulated run that is paused at mission second 0. The function `do` sends requests of a user. Then the run
    continues to its end.
    """
    interventions = Interventions(asked, virtual_time=True, paused=True)
    over = threading.Event()

    def click() -> None:
        while interventions.closed and not over.is_set():
            over.wait(0.005)
        try:
            do(interventions)
        finally:
            interventions.resume()

    with ThreadPoolExecutor(1) as thread:
        clicked = thread.submit(click)
        try:
            finished = run(asked, 7, out, SilentProgress(), "sim", interventions=interventions)
        finally:
            over.set()
        clicked.result(TIMEOUT_S)
    return finished


def files_of(run: Path) -> dict[str, bytes]:
    """Return the contents of the agents' files."""
    return {str(path.relative_to(run)): path.read_bytes() for path in sorted((run / "agents").rglob("*.json*"))}


def test_replay_of_requests_gives_the_same_files(tmp_path: Path) -> None:
    asked = scenario(duration_s=600, network={"loss": 0.1}, timeline=[{"at_s": 40, "loss": 0.2}], final_reconcile=True)
    at_s: list[float] = []

    def click(interventions: Interventions) -> None:
        def ask(**entry: Any) -> None:
            at_s.append(interventions.ask(entry).result(TIMEOUT_S))

        ask(partition=[[1, 2], [3, 4]])
        assert interventions.step(30).result(TIMEOUT_S) == pytest.approx(30.001)
        interventions.step_to_next_run().result(TIMEOUT_S)
        ask(kill=[2])
        ask(reboot=[3], down_s=30, disk="kept")
        interventions.step_to_next_run().result(TIMEOUT_S)
        ask(reboot=[4], down_s=20.5, disk="lost")
        interventions.step(100).result(TIMEOUT_S)
        ask(heal=True)
        ask(network={"links": [{"from": 1, "to": 3, "loss": 0.9}]})
        interventions.step(100).result(TIMEOUT_S)
        ask(loss=0.0)

    finished = played(asked, tmp_path / "run", click)
    assert finished.record.scenario is not None
    assert [entry.at_s for entry in finished.record.scenario.timeline] == [40.0, *at_s]
    marked = {fault.at_s: fault.what for fault in finished.record.faults if fault.by_hand}
    assert list(marked.values()) == ["partition", "kill", "reboot", "reboot", "heal", "network", "loss"]
    assert [*marked] == at_s
    again = run(load_scenario(tmp_path / "run/replay.yaml"), 7, tmp_path / "again", SilentProgress(), "sim")
    assert files_of(tmp_path / "again") == files_of(tmp_path / "run")
    assert again.record.agents == finished.record.agents
    assert again.result.to_json() == finished.result.to_json()
    assert not any(fault.by_hand for fault in again.record.faults)


def test_run_without_requests_equals_a_normal_run(tmp_path: Path) -> None:
    asked = scenario(duration_s=300, network={"loss": 0.1})
    played(asked, tmp_path / "watched", lambda interventions: None)
    run(asked, 7, tmp_path / "alone", SilentProgress(), "sim")
    assert files_of(tmp_path / "watched") == files_of(tmp_path / "alone")
    assert not (tmp_path / "watched/replay.yaml").exists()


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"kill": [2]}, "kill: agent 2 is killed at that time, not running or paused"),
    ({"kill": [9]}, "kill names vehicle 9, which is not on the roster: use one of 1, 2, 3, 4, 5"),
    ({"loss": 1.5}, "`loss` is 1.5: it should be less than or equal to 1"),
    ({"partition": [[1, 2], [2, 3]]}, "vehicle 2 is in an earlier group too"),
    ({"lose": 0.5}, "`lose` is unknown: use one of"),
    ({}, "needs exactly one of `loss`"),
    ({"at_s": 5, "loss": 0.5}, "a command acts now: leave out `at_s`"),
    ({"reboot": [1]}, "a reboot needs `down_s`"),
    ({"reboot": [1], "down_s": 1e6, "disk": "lost"}, "after the mission's end at 300 s"),
    ({"kill": [3]}, "the timeline's entry at 200 s, kill: agent 3 is killed at that time, not running or paused"),
    ({"loss": 0.5}, "this changes loss for good, but the timeline's entry at 90 s changes it until 150 s: let this"),
]


def test_impossible_request_causes_one_sentence_and_changes_nothing(tmp_path: Path) -> None:
    strained = {"at_s": 90, "network": {"loss": 0.3, "delay": 0.1}, "for_s": 60}
    asked = scenario(duration_s=300, timeline=[strained, {"at_s": 200, "kill": [3]}])
    wrong: list[str] = []

    def click(interventions: Interventions) -> None:
        interventions.step(100).result(TIMEOUT_S)
        interventions.ask({"kill": [2]}).result(TIMEOUT_S)
        before = interventions.scenario
        for entry, sentence in REFUSED:
            with pytest.raises(ScenarioError) as refusal:
                interventions.ask(entry).result(TIMEOUT_S)
            if sentence not in str(refusal.value):
                wrong.append(str(refusal.value))
        assert interventions.scenario is before
        for seconds in (0, -1, float("nan"), float("inf")):
            with pytest.raises(ScenarioError, match="is not a step"):
                interventions.step(seconds).result(TIMEOUT_S)
        with pytest.raises(ScenarioError, match="is not a speed: use a number above 0"):
            interventions.set_factor(0).result(TIMEOUT_S)

    played(asked, tmp_path / "run", click)
    assert wrong == []


def test_lasting_request_ends_a_temporary_change(tmp_path: Path) -> None:
    timeline = [{"at_s": 50, "partition": [[1, 2]], "for_s": 500}, {"at_s": 60, "loss": 0.5, "for_s": 400}]
    asked = scenario(duration_s=600, timeline=timeline)

    def click(interventions: Interventions) -> None:
        interventions.step(100).result(TIMEOUT_S)
        interventions.ask({"heal": True}).result(TIMEOUT_S)
        interventions.ask({"loss": 0.1}).result(TIMEOUT_S)

    finished = played(asked, tmp_path / "run", click)
    faults = [(fault.at_s, fault.what, fault.detail) for fault in finished.record.faults]
    assert faults[2:] == [(100.0, "heal, undone", "loss 50 %"), (100.001, "loss, undone", "loss 10 %")]
    run(load_scenario(tmp_path / "run/replay.yaml"), 7, tmp_path / "again", SilentProgress(), "sim")
    assert files_of(tmp_path / "again") == files_of(tmp_path / "run")


def test_replay_with_flying_vehicles_gives_the_same_files(tmp_path: Path) -> None:
    radio = {"hard_range": {"range_m": 100}, "update_s": 1}
    flight = [{"vehicles": [1], "plan": [{"take_off": 20}, {"go_to": [300, 0]}, {"go_to": [0, 0]}]}]
    schedule = [{"nemesis": "halves", "every_s": 50, "for_s": 20}]
    network, events = {"radio": radio}, {"mean_s": 2}
    asked = scenario(duration_s=300, agents=3, network=network, flight=flight, schedule=schedule, events=events)

    def click(interventions: Interventions) -> None:
        for number in range(40):
            interventions.step_to_next_run().result(TIMEOUT_S)
            if number % 10 == 9:
                interventions.step(0.5).result(TIMEOUT_S)
                interventions.ask({"loss": number / 100}).result(TIMEOUT_S)

    played(asked, tmp_path / "run", click)
    run(load_scenario(tmp_path / "run/replay.yaml"), 7, tmp_path / "again", SilentProgress(), "sim")
    assert files_of(tmp_path / "again") == files_of(tmp_path / "run")
    assert (tmp_path / "again/tracks.jsonl").read_bytes() == (tmp_path / "run/tracks.jsonl").read_bytes()


def test_foreign_agents_get_only_requests_that_they_support(tmp_path: Path) -> None:
    node = [sys.executable, "-m", "ucp.node"]
    rebooted = [{"at_s": 80, "reboot": [1], "down_s": 5, "disk": "kept"}]
    asked = scenario(duration_s=100, agents=2, agent_command={2: node}, timeline=rebooted)

    def click(interventions: Interventions) -> None:
        interventions.step(20).result(TIMEOUT_S)
        with pytest.raises(ScenarioError, match="agent 2 has no disk"):
            interventions.ask({"reboot": [1, 2], "down_s": 5, "disk": "kept"}).result(TIMEOUT_S)
        with pytest.raises(ScenarioError, match="`flood` needs a rogue node"):
            interventions.ask({"flood": {"per_s": 10, "for_s": 1}}).result(TIMEOUT_S)
        interventions.ask({"reboot": [1], "down_s": 5, "disk": "kept"}).result(TIMEOUT_S)
        interventions.ask({"reboot": [2], "down_s": 5, "disk": "lost"}).result(TIMEOUT_S)

    assert played(asked, tmp_path / "run", click).played.outcome == "completed"


def test_second_request_after_a_refusal_is_answered(tmp_path: Path) -> None:
    def click(interventions: Interventions) -> None:
        interventions.step(20).result(TIMEOUT_S)
        refused = interventions.ask({"kill": [99]})
        refused.add_done_callback(lambda _: again.append(interventions.ask({"kill": [98]})))  # in the thread of the run
        for answer in (refused, *again):
            with pytest.raises(ScenarioError):
                answer.result(TIMEOUT_S)
        threading.Event().wait(0.2)  # the run waits again
        interventions.ask({"kill": [2]}).result(TIMEOUT_S)

    again: list[Future[float]] = []
    assert played(scenario(duration_s=40), tmp_path / "run", click).played.outcome == "completed"


def test_requests_before_and_after_the_run_are_refused(tmp_path: Path) -> None:
    asked = scenario(duration_s=100)
    interventions = Interventions(asked, virtual_time=True)
    with pytest.raises(ScenarioError, match="the mission has not started"):
        interventions.ask({"loss": 0.5}).result(0)
    run(asked, 7, tmp_path / "run", SilentProgress(), "sim", interventions=interventions)
    with pytest.raises(ScenarioError, match="the run has ended"):
        interventions.ask({"loss": 0.5}).result(0)
    with pytest.raises(ScenarioError, match="has ended"):
        interventions.pause().result(0)


def test_request_beyond_the_maximum_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def click(interventions: Interventions) -> None:
        monkeypatch.setattr("harness.play.interventions.MAX_WAITING", 0)
        with pytest.raises(ScenarioError, match="0 commands are waiting: repeat this command later"):
            interventions.ask({"loss": 0.5}).result(TIMEOUT_S)

    assert played(scenario(duration_s=20), tmp_path / "run", click).record.faults == []


def test_pause_is_refused_in_real_time() -> None:
    interventions = Interventions(scenario(), virtual_time=False)
    with pytest.raises(ScenarioError, match="the time of real processes cannot be paused"):
        interventions.pause().result(0)


def test_other_process_sends_requests_to_the_socket(tmp_path: Path) -> None:
    out = tmp_path / ("a directory that lies deep " * 4) / "run"
    answers: dict[str, Any] = {}

    def click(interventions: Interventions) -> None:
        async def ask() -> None:
            directory = os.open(out, os.O_PATH)
            reader, writer = await asyncio.open_unix_connection(f"/proc/self/fd/{directory}/{SOCKET}")
            for line in LINES:
                writer.write(line.encode() + b"\n")
                answers[line] = json.loads(await asyncio.wait_for(reader.readline(), TIMEOUT_S))
            writer.close()
            os.close(directory)

        asyncio.run(ask())

    assert played(scenario(duration_s=100, agents=3), out, click).exit_status == 0
    wrong = {line: answer["error"] for line, answer in answers.items() if not answer["ok"]}
    assert [answer.get("at_s") for answer in answers.values()][:4] == [10.0, 10.0, 10.001, 10.001]
    assert answers[LINES[3]]["by_hand"] == [{"at_s": 10.0, "kill": [2]}, {"at_s": 10.001, "loss": 0.5}]
    assert answers[LINES[3]]["paused"] and answers[LINES[3]]["closed"] is None
    assert [*wrong] == [*LINES[4:]]
    assert wrong[LINES[4]].startswith("kill: agent 2 is killed at that time")
    assert not (out / SOCKET).exists()
    assert wrong[LINES[-1]] == "the request has more than 65536 bytes"


LINES = (
    '{"command": "step", "seconds": 10}',
    '{"command": "happen", "entry": {"kill": [2]}}',
    '{"command": "happen", "entry": {"loss": 0.5}}',
    '{"command": "state"}',
    '{"command": "happen", "entry": {"kill": [2], "for_s": null}}',
    '{"command": "happen", "entry": [1]}',
    '{"command": "step", "seconds": "10"}',
    '{"command": "step", "seconds": 1e400}',
    '{"command": "pace", "factor": true}',
    '{"command": ["pause"]}',
    "[" * 10_000,
    "pause",
    "[]",
    "null",
    " " * 70_000,
)
