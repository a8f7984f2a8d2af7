"""Test the fixture `swarm`: a test controls a run, which the checker judges when the test ends."""

import json
import re
from pathlib import Path

import pytest
import yaml

from harness.archive.exports import read_export
from harness.play.progress import SilentProgress
from harness.run.run import run as play
from harness.scenario.load import parse
from tests.pytest_plugin.inner import SCENARIOS, no_internals, report, run, run_directories

pytest_plugins = "pytester"

STORY = """
    def test_story(swarm):
        swarm.partition([1, 2], [3, 4, 5])
        swarm.run_for(600)
        apart = swarm.characteristic(6)
        swarm.heal()
        swarm.wait_idle()
        assert (apart.verdict, apart.holds) == ("not applicable", False)
        assert swarm.characteristic(6).holds
        assert swarm.chain(1) == swarm.chain(4)
        assert {name.split(".")[0] for name in swarm.chain(1)} == set("12345")
        assert swarm.figures["mutual_chain"] == len(swarm.chain(1))
"""

REPOSITORY = Path(__file__).parents[2]
PAGE = REPOSITORY / "docs/how-to/test-with-pytest.md"
FORCED_TIE = {
    **yaml.safe_load((SCENARIOS / "forced_tie.yaml").read_text()),
    "quirks": {"crash_on_tie": True},
    "expect": {},
}


def test_story_of_a_partition_passes_and_leaves_nothing(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(STORY)
    run(pytester).assert_outcomes(passed=1)
    assert not run_directories(pytester)


@pytest.mark.parametrize("seed", range(2, 12))
def test_story_holds_with_any_seed(pytester: pytest.Pytester, seed: int) -> None:
    pytester.makepyfile(STORY)
    run(pytester, "--ucp-seed", seed).assert_outcomes(passed=1)


def test_partition_heals_at_the_end_of_its_block(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        def test_story(swarm):
            with swarm.partition([1, 2], [3, 4, 5]):
                swarm.run_for(300)
            swarm.run_for(100)
        """
    )
    run(pytester, "--ucp-keep", pytester.path / "kept").assert_outcomes(passed=1)
    (record,) = (pytester.path / "kept").glob("*/run.json")
    entries = json.loads(record.read_text())["scenario"]["timeline"]
    assert [(entry["at_s"], entry["partition"], entry["heal"]) for entry in entries] == [
        (0.001, [[1, 2], [3, 4, 5]], None),
        (300.001, None, True),
    ]


@pytest.mark.lab
@pytest.mark.any_user
def test_processes_pass_the_same_test(pytester: pytest.Pytester) -> None:
    """The partition is shorter, so a lower speedup is enough. At this speedup, a busy machine does not delay a vote too
    long.
    """
    pytester.makepyfile(STORY.replace("run_for(600)", "run_for(200)"))
    run(pytester, "--ucp-backend", "process", "--ucp-speedup", "20").assert_outcomes(passed=1)
    assert not run_directories(pytester)


def test_tests_in_the_documentation_pass(pytester: pytest.Pytester) -> None:
    for number, page in enumerate((REPOSITORY / "README.md", PAGE)):
        code = [
            block for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL) if "def test_" in block
        ]
        pytester.makepyfile(**{f"test_{number}": "\n\n".join(["import pytest", *code])})
    (pytester.path / "scenarios").symlink_to(SCENARIOS)
    run(pytester).assert_outcomes(passed=6)
    (expect,) = re.findall(r"```yaml\n(expect:.*?)```", PAGE.read_text(), re.DOTALL)
    scenario, _, _ = (SCENARIOS / "loss_15.yaml").read_text().partition("expect:")
    (pytester.path / "my.yaml").write_text(scenario + expect)
    run(pytester, "my.yaml", "--ucp-backend", "sim").assert_outcomes(passed=3)


FAULTS = """
    import pytest

    @pytest.mark.swarm(agents=[3, 7, 20, 40], speedup=50)
    def test_faults(swarm):
        swarm.run_until(100)
        swarm.kill(3)
        with pytest.raises(Exception, match="kill: agent 3 is killed at that time"):
            swarm.kill(3)
        with pytest.raises(Exception, match="reconcile: agent 3 is killed at that time, not running"):
            swarm.reconcile(3)
        swarm.pause(7)
        swarm.run_for(50)
        swarm.resume(7)
        swarm.reboot(20, down_s=10, disk="kept")
        swarm.run_for(200)
        held = len(swarm.chain(20))
        assert held > 0
        swarm.restart(3)
        swarm.reboot(40, down_s=10, disk="lost")
        swarm.run_for(200)
        assert swarm.characteristic(3).holds
        assert swarm.characteristic(4).holds
        swarm.loss(0.5)
        swarm.run_for(20)
        swarm.final_reconcile()
        with pytest.raises(Exception, match="the final reconcile is over"):
            swarm.final_reconcile()
        assert swarm.characteristic(6).holds
        assert len(swarm.chain(3)) == len(swarm.chain(20)) > held
"""


def test_agents_are_killed_paused_rebooted_and_come_back(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(FAULTS)
    run(pytester, "--ucp-keep", "kept").assert_outcomes(passed=1)
    (kept,) = run_directories(pytester)
    record = json.loads((kept / "run.json").read_text())
    assert [fault["what"] for fault in record["faults"]] == [
        *("kill", "pause", "resume", "reboot", "boot", "restart", "reboot", "boot", "loss", "final reconcile")
    ]
    assert [(one["restarts"], one["reboots"]) for one in record["agents"].values()] == [(1, 0), (0, 0), (0, 1), (1, 0)]


def test_wait_idle_ignores_landed_and_stopped_agents(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
    def test_landing(swarm):
        swarm.run_for(200)
        swarm.stop_events(1)
        swarm.switch_off(2)
        swarm.wait_idle()
        swarm.run_for(60)
        assert len(swarm.chain(1)) > len(swarm.chain(2)) > 0
        assert swarm.characteristic(6).holds
    """)
    run(pytester).assert_outcomes(passed=1)


@pytest.mark.lab
@pytest.mark.any_user
def test_processes_are_killed_paused_rebooted_and_come_back(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(FAULTS)
    run(pytester, "--ucp-backend", "process", "--ucp-keep", "kept").assert_outcomes(passed=1)
    (kept,) = run_directories(pytester)
    record = json.loads((kept / "run.json").read_text())
    assert {one["verdict"] for one in record["characteristics"].values()} <= {"holds", "not applicable"}
    assert not record["errors"]


def test_queries_change_nothing_and_the_run_can_be_played_again(pytester: pytest.Pytester, tmp_path: Path) -> None:
    look = "swarm.characteristic(1), swarm.chain(2), swarm.figures"
    pytester.makepyfile(f"""
    import pytest

    def tell(swarm, look):
        swarm.loss(0.1)
        swarm.partition([1], [2, 3])
        for _ in range(5):
            swarm.run_for(41.7)
            look and ({look})
        swarm.kill(4)
        swarm.heal()
        swarm.run_for(100)

    pytestmark = pytest.mark.swarm(name="action", final_reconcile=True)
    def test_looking(swarm): tell(swarm, True)
    def test_not_looking(swarm): tell(swarm, False)
    """)
    run(pytester, "--ucp-keep", "kept", "--ucp-seed", 4).assert_outcomes(passed=2)
    looking, not_looking = sorted(run_directories(pytester))
    record = json.loads((looking / "run.json").read_text())
    assert record["scenario"]["duration_s"] == pytest.approx(308.503)
    play(parse(record["scenario"]), 4, tmp_path / "again", SilentProgress(), "sim")
    for agent in (1, 2, 3, 5):
        exports = [read_export(path / "agents" / f"{agent}.chain.json") for path in (looking, not_looking)]
        assert exports[0] == exports[1] == read_export(tmp_path / "again" / "agents" / f"{agent}.chain.json")


def test_violation_fails_the_test_with_its_evidence_and_its_report(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(f"""
    import pytest

    @pytest.mark.swarm(**{FORCED_TIE!r})
    def test_tie(swarm):
        swarm.run_for(60)
    """)
    result = run(pytester)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "*_ test_tie _*",
            "characteristic 1, distributed: violated: 1 time: *",
            "    agent 1: trace line *, t=* s: a reconcile did not continue within * s",
            "report: *",
        ]
    )
    no_internals(result)
    assert json.loads((report(result).parent / "run.json").read_text())["characteristics"]["1"]["verdict"] == "violated"


def test_expected_violation_passes_and_a_missing_one_fails(pytester: pytest.Pytester) -> None:
    expect = {
        "characteristics": {1: "violated", 5: "violated", 6: "violated"},
        "steps": "deviates",
        "liveness": "never finishes",
    }
    pytester.makepyfile(f"""
    import pytest

    pytestmark = pytest.mark.swarm(expect={expect!r})

    @pytest.mark.swarm(**{{**{FORCED_TIE!r}, "expect": {expect!r}}})
    def test_tie(swarm):
        swarm.run_for(60)
        assert swarm.characteristic(1).verdict == "violated"
        assert swarm.characteristic(1).evidence[0].agent_id == 1

    def test_no_tie(swarm):
        swarm.run_for(60)
    """)
    result = run(pytester)
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["characteristic 1, distributed: holds: *", "    expected: violated"])


def test_failing_assert_shows_the_verdict_and_the_report_path(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
    def test_apart(swarm):
        swarm.partition([1], [2, 3, 4, 5])
        swarm.run_for(300)
        assert swarm.characteristic(6).holds
    """)
    result = run(pytester)
    result.assert_outcomes(failed=1)
    reason = (
        "not applicable: 2 distinct chains, which share * the system was not fully connected: *partition 1 | 2 3 4 5"
    )
    result.stdout.fnmatch_lines(
        [f"E * where False = <characteristic 6, one uniform chain: {reason}>.holds", "*- Captured ucp call -*"]
    )
    no_internals(result)
    report(result)


def test_end_of_a_test_waits_for_temporary_changes(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
    def test_network(swarm):
        swarm.run_until(100)
        swarm.network(links=[{"from": 1, "to": 2, "loss": 0.9}], for_s=50)
        swarm.loss(0.3, for_s=10)
        swarm.run_for(20)
        swarm.partition([1], for_s=60)
    """)
    run(pytester, "--ucp-keep", "kept").assert_outcomes(passed=1)
    (kept,) = run_directories(pytester)
    record = json.loads((kept / "run.json").read_text())
    assert [(fault["what"], fault["detail"]) for fault in record["faults"]] == [
        ("network", "loss 0 %, loss 90 % from 1 to 2"),
        ("loss", "loss 30 %, loss 90 % from 1 to 2"),
        ("undone", "loss 0 %, loss 90 % from 1 to 2"),
        ("partition", "loss 0 %, loss 90 % from 1 to 2, partition 1"),
        ("undone", "loss 0 %, partition 1"),
        ("undone", "loss 0 %"),
    ]


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        ("swarm.partition([1], [9])", "partition[[]1]: unknown vehicle 9; allowed is any of 1, 2, 3, 4, 5"),
        ("swarm.loss(2)", "`loss` is 2: *"),
        ("swarm.network(lost=1)", "`network.lost` is unknown: use one of loss, delay, *"),
        ("swarm.loss(0.5, for_s=9); swarm.heel()", "a swarm has no 'heel'; use one of *kill, *"),
        ("swarm.reboot(2, disk='half')", "`disk` is 'half': it should be 'kept' or 'lost'"),
        ("swarm.restart(2)", "restart: agent 2 is running at that time, not killed"),
        ("swarm.kill(1, 2, 3, 4, 5)", "the timeline kills all agents: *"),
        ("swarm.characteristic(7)", "no characteristic 7: use 1 to 6"),
        ("swarm.judgement('6')", "no judgement '6': use one of steps, records, liveness"),
        ("swarm.run_for(-5)", "a mission cannot run for -5 s: use a time above 0"),
        ("swarm.run_for(9); swarm.run_until(8)", "a mission cannot run until 8 s: it is at 9 s"),
        ("swarm.run_until(float('inf'))", "a mission cannot run until inf s: it is at 0 s"),
        ("swarm.chain(6)", "no chain of agent 6; agents with a chain: [[]1, 2, 3, 4, 5[]]"),
        ("swarm.pause(1); swarm.wait_idle(20)", "within 20 mission seconds not every agent has voted and become idle"),
    ],
)
def test_impossible_action_is_reported_at_the_line_of_the_test(
    pytester: pytest.Pytester, action: str, sentence: str
) -> None:
    pytester.makepyfile(f"def test_mistake(swarm):\n    {action}")
    result = run(pytester)
    result.assert_outcomes(failed=1)
    shown = f">   *{action.split('; ')[0]}*".replace("[", "[[]")
    result.stdout.fnmatch_lines([shown, f"E   *Error: {sentence}", "*.py:2: *Error"])
    no_internals(result)


@pytest.mark.parametrize(
    ("marker", "sentence"),
    [
        ("agent=7", "`agent` is unknown: use one of name, *"),
        ("backend='kernel'", "`backend` is 'kernel': use 'process', 'docker' or 'sim'"),
        ("seed=-1", "`seed` is -1: use a number from 0 on"),
        ("agent_command=['./x']", "`agent_command`: ./x is not a program: *"),
    ],
)
def test_impossible_swarm_is_reported_in_one_sentence(pytester: pytest.Pytester, marker: str, sentence: str) -> None:
    pytester.makepyfile(f"import pytest\n@pytest.mark.swarm({marker})\ndef test_mistake(swarm): pass")
    result = run(pytester)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*_ ERROR at setup of test_mistake _*", sentence])
    no_internals(result)


@pytest.mark.lab
def test_dying_agent_fails_the_current_action(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
    import os, pytest, signal
    from tests.harness.command import processes

    @pytest.mark.swarm(agents=2, backend="process", speedup=50)
    def test_dies(swarm):
        swarm.run_for(10)
        (pid,) = [pid for pid, command in processes(swarm.directory).items() if "2.mission.json" in command]
        os.kill(pid, signal.SIGKILL)
        swarm.run_for(100_000)
    """)
    result = run(pytester)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [">       swarm.run_for(100_000)", "E *RunEndedError: agent 2 ended by itself with SIGKILL*"]
    )
    no_internals(result)
    assert json.loads((report(result).parent / "run.json").read_text())["outcome"] == "failed"


def test_steps_and_records_are_judged_during_a_run(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
    import pytest

    def test_right(swarm):
        swarm.run_for(200)
        assert swarm.judgement("steps").holds and swarm.judgement("records").holds

    @pytest.mark.swarm(quirks={"approve_everything": True}, network={"loss": 0.4}, expect={"steps": "deviates"})
    def test_wrong(swarm):
        swarm.run_for(600)
        assert swarm.judgement("steps").verdict == "deviates"
        assert swarm.judgement("steps").evidence[0].handler == "receive_request_add_block"
    """)
    run(pytester).assert_outcomes(passed=2)
