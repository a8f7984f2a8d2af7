"""Test the other methods of the fixture `swarm`: wait for a handler, hold messages, change links, and inject
datagrams.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from harness.archive.exports import read_export
from harness.play.progress import SilentProgress
from harness.run.run import run as play
from harness.scenario.load import parse
from tests.pytest_plugin.inner import no_internals, run, run_directories

pytest_plugins = "pytester"


def record(pytester: pytest.Pytester) -> dict[str, Any]:
    """Return the record of the run. Only one run may be stored."""
    (kept,) = run_directories(pytester)
    document: dict[str, Any] = json.loads((kept / "run.json").read_text())
    return document


def given(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{key: value for key, value in entry.items() if value not in (None, False, {}, [])} for entry in entries]


def assert_plays_again_alike(pytester: pytest.Pytester, directory: Path) -> None:
    """Check that the recorded scenario gives the same chain when it is played again."""
    (kept,) = run_directories(pytester)
    run_record = record(pytester)
    play(parse(run_record["scenario"]), run_record["seed"], directory, SilentProgress(), "sim")
    for agent in run_record["agents"]:
        first, again = (read_export(path / "agents" / f"{agent}.chain.json") for path in (kept, directory))
        assert first.chain == again.chain


WAITING = """
    import pytest

    @pytest.mark.swarm(agents=4, speedup=50, events={"source": "random", "mean_s": 30})
    def test_waiting(swarm):
        leader = swarm.wait_for("vote_timer_expiration", "approved")
        first_s = swarm.now_s
        assert leader in (1, 2, 3, 4)
        assert swarm.wait_for("receive_commit_block", "committed", agent=3 if leader != 3 else 4, limit_s=300) != leader
        assert len(swarm.chain(leader)) >= 1 and swarm.now_s >= first_s
        swarm.reconcile(2)
        assert swarm.wait_for("reconcile_begin", agent=2, limit_s=5) == 2
        with pytest.raises(AssertionError, match="^within 0 mission seconds agent 1 has not run reconcile_begin with"):
            swarm.wait_for("reconcile_begin", "begun", agent=1, limit_s=0)
"""


def test_wait_for_continues_until_an_agent_runs_a_handler(pytester: pytest.Pytester, tmp_path: Path) -> None:
    pytester.makepyfile(WAITING)
    run(pytester, "--ucp-keep", "kept").assert_outcomes(passed=1)
    assert [entry["reconcile"] for entry in record(pytester)["scenario"]["timeline"]] == [[2]]
    assert_plays_again_alike(pytester, tmp_path / "again")


@pytest.mark.lab
def test_wait_for_works_with_processes(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(WAITING)
    run(pytester, "--ucp-backend", "process").assert_outcomes(passed=1)


def test_wait_for_stops_at_the_moment_of_the_handler_run(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
    import json

    def test_moment(swarm):
        for _ in range(20):
            agent = swarm.wait_for("receive_request_add_block")
            swarm.figures
            trace = (swarm.directory / "agents" / f"{agent}.trace.jsonl").read_text().splitlines()
            last = json.loads(trace[-1])
            assert last["handler"] == "receive_request_add_block" and abs(last["t"] - swarm.now_s) < 1e-5
    """)
    run(pytester).assert_outcomes(passed=1)


def test_wait_for_finds_messages_without_effect(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
    def test_votes_of_others(swarm):
        swarm.wait_for("receive_vote_add_block", "no vote running", agent=3, limit_s=600)

    def test_busy(swarm):
        with swarm.hold("Block Add Request", receiver=3):
            swarm.wait_for("receive_request_add_block", agent=4)
            swarm.run_for(1)
            swarm.reconcile(3)
        swarm.wait_for("receive_request_add_block", "reconcile in progress", agent=3, limit_s=1)
    """)
    run(pytester).assert_outcomes(passed=2)


HELD = """
    def test_held(swarm):
        with swarm.hold("Commit Block", receiver=3):
            swarm.wait_for("receive_commit_block", "committed", agent=4)
            swarm.run_for(1)
            assert len(swarm.chain(4)) > len(swarm.chain(3)) == 0
        released_s = swarm.now_s
        assert swarm.wait_for("receive_commit_block", agent=3, limit_s=1) == 3
        assert swarm.now_s - released_s <= 0.002
        with swarm.hold():
            swarm.wait_for("process_next_deque_block", "proposed")
            swarm.release()
        swarm.hold(sender=5, receiver=2)
        swarm.hold("Block Add Response", count=[1, 2])
        swarm.run_for(200)
        swarm.release(sender=5, receiver=2)
        swarm.run_for(100)
        swarm.loss(0.2)
        swarm.run_for(100)
"""


def test_messages_are_held_back_and_released(pytester: pytest.Pytester, tmp_path: Path) -> None:
    pytester.makepyfile(HELD)
    run(pytester, "--ucp-keep", "kept").assert_outcomes(passed=1)
    first, every, second, third = given(record(pytester)["scenario"]["fates"])
    assert first["message"] == "Commit Block" and first["receiver"] == 3 and first["from_s"] == 0.001
    for fate in (first, every, second, third):
        assert fate["from_s"] < fate["until_s"] == fate["hold_until_s"]
    assert third["until_s"] - second["until_s"] == pytest.approx(200, abs=0.01), "the end of the test releases it"
    assert_plays_again_alike(pytester, tmp_path / "again")


def test_hold_without_messages_fails_the_test(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("def test_nothing(swarm):\n    swarm.hold('Block Response')\n    swarm.run_for(9)")
    result = run(pytester)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["fates.0 (hold until * s Block Response *) matched no message, so this run *"])


def test_conditions_last_as_long_as_their_block(pytester: pytest.Pytester, tmp_path: Path) -> None:
    pytester.makepyfile("""
    def test_blocks(swarm):
        swarm.run_until(10)
        with swarm.loss(0.3):
            swarm.run_for(50)
            with swarm.link(1, [2, 3], loss=1.0):
                swarm.run_for(50)
            swarm.link(4, 5, loss=0.9, both=True)
        with swarm.network(delay=0.2, for_s=5):
            swarm.run_for(20)
    """)
    run(pytester, "--ucp-keep", "kept").assert_outcomes(passed=1)
    run_record = record(pytester)
    assert [(fault["what"], fault["detail"]) for fault in run_record["faults"]] == [
        ("loss", "loss 30 %"),
        ("network", "loss 30 %, loss 100 % from 1 to 2 3"),
        ("undone", "loss 30 %"),
        ("network", "loss 30 %, loss 90 % from 4 to 5, loss 90 % from 5 to 4"),
        ("undone", "loss 0 %, loss 90 % from 4 to 5, loss 90 % from 5 to 4"),
        ("network", "loss 0 %, delay 200 ms, loss 90 % from 4 to 5, loss 90 % from 5 to 4"),
        ("undone", "loss 0 %, loss 90 % from 4 to 5, loss 90 % from 5 to 4"),
    ]
    assert [entry.get("for_s") for entry in given(run_record["scenario"]["timeline"])] == [100.004, 50.001, None, 5]
    assert_plays_again_alike(pytester, tmp_path / "again")


INJECTIONS = """
    import pytest

    @pytest.mark.swarm(expect={"characteristics": {1: "violated"}})
    def test_rogue(swarm):
        swarm.run_until(200)
        swarm.replay("Commit Block", count=2)
        swarm.duplicate(for_s=50, copies=2)
        swarm.delay("Block Add Request", for_s=50, by_s=5)
        swarm.corrupt(for_s=50, bits=3)
        swarm.run_for(60)
        swarm.forge("Block Add Response", sender=2, approve=False, for_s=100)
        swarm.flood(for_s=1, per_s=20)
"""


def test_late_rogue_node_knows_earlier_messages(pytester: pytest.Pytester, tmp_path: Path) -> None:
    pytester.makepyfile(INJECTIONS)
    run(pytester, "--ucp-keep", "kept").assert_outcomes(passed=1)
    run_record = record(pytester)
    names = ["replay", "duplicate", "delay", "corrupt", "forge", "flood"]
    assert [fault["what"] for fault in run_record["faults"]] == names
    assert [injection["what"] for injection in run_record["rogue"]] == names
    assert all(injection["sent"] for injection in run_record["rogue"])
    assert_plays_again_alike(pytester, tmp_path / "again")


@pytest.mark.lab
@pytest.mark.parametrize("action", ["hold('Commit Block')", "replay('Commit Block')"])
@pytest.mark.any_user
def test_action_that_needs_virtual_time_is_refused_and_the_run_continues(
    pytester: pytest.Pytester, action: str
) -> None:
    pytester.makepyfile(f"""
    import pytest

    @pytest.mark.swarm(agents=2, backend="process", speedup=100, events={{"source": "random"}})
    def test_processes(swarm):
        with pytest.raises(Exception, match="use --backend sim$"):
            swarm.{action}
        with swarm.link(1, 2, loss=0.5):
            swarm.run_for(20)
    """)
    run(pytester, "--ucp-keep", "kept").assert_outcomes(passed=1)
    scenario = record(pytester)["scenario"]
    assert not scenario["fates"] and [entry["replay"] for entry in scenario["timeline"]] == [None]


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        ("swarm.wait_for('commit')", "ScenarioError: no handler 'commit': use one of build_data_block, *"),
        (
            "swarm.wait_for('vote_timer_expiration', 'won')",
            "ScenarioError: vote_timer_expiration has no branch 'won': use one of '*",
        ),
        (
            "swarm.wait_for('vote_timer_expiration', agent=9)",
            "ScenarioError: no agent 9: use one of 1, 2, 3, 4, 5",
        ),
        (
            "swarm.wait_for('vote_timer_expiration', limit_s=-1)",
            "ScenarioError: a wait needs a limit of 0 s or more, not -1 s",
        ),
        (
            "swarm.wait_for('vote_timer_expiration', agent=3, limit_s=0.5)",
            "AssertionError: within 0.5 mission seconds agent 3 has not run vote_timer_expiration",
        ),
        ("swarm.hold('Commit')", "ScenarioError: `message` is 'Commit': it should be *"),
        ("swarm.hold(sender=9)", "ScenarioError: *sender names vehicle 9, which is not on the roster: *"),
        ("swarm.hold(drop=True)", "ScenarioError: `drop` is unknown: use one of message, sender, *"),
        ("swarm.hold(sender=2); swarm.hold(sender=2)", "ScenarioError: sender=2 is held already"),
        ("swarm.release(sender=2)", "ScenarioError: sender=2 is not held; held: nothing"),
        (
            "swarm.hold(sender=2); swarm.release('Commit')",
            "ScenarioError: message='Commit' is not held; held: sender=2",
        ),
        ("swarm.wait_for(['vote'])", "ScenarioError: no handler [[]'vote'[]]: use one of *"),
        ("swarm.link(1, 1, loss=1)", "ScenarioError: *a link from vehicle 1 to itself is impossible"),
        ("swarm.link(1, 9, loss=1)", "ScenarioError: *names vehicle 9, which is not on the roster: *"),
        ("swarm.link(1, 2)", "ScenarioError: a link needs a condition of its own, such as loss=0.9"),
        (
            "with swarm.loss(0.3): swarm.run_for(5); swarm.loss(0.5)",
            "ScenarioError: the `with` block cannot undo its change, because the same *",
        ),
        ("swarm.replay(count=0)", "ScenarioError: `replay.count` is 0: *"),
        ("swarm.flood(for_s=5)", "ScenarioError: `flood.per_s` is missing*"),
    ],
)
def test_impossible_action_is_reported_at_the_line_of_the_test(
    pytester: pytest.Pytester, action: str, sentence: str
) -> None:
    pytester.makepyfile(f"def test_mistake(swarm):\n    {action}")
    result = run(pytester)
    result.assert_outcomes(failed=1)
    shown = f">   *{action.split('; ')[0]}*".replace("[", "[[]")
    result.stdout.fnmatch_lines([shown, f"E   *{sentence}", "*.py:2: *Error"])
    no_internals(result)
