"""Test errors of a foreign agent in virtual time. The record of the run contains one sentence that names the agent."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from harness.errors import UnsupportedError
from harness.play.progress import SilentProgress
from harness.play.simulation.foreign import _foreign_agent, line_program
from harness.run.run import Run, run
from harness.run.simulate import simulate
from harness.scenario.verdict_names import ENDED
from tests.harness.play.foreign.agents import EXPORT, living, played_by, small
from ucp.messages import BlockAddRequest, encode
from ucp.trace import in_base64

SHORT = {"agents": 2, "duration_s": 30, "events": {"source": "scripted", "script": [{"at_s": 12.5, "agent": 2}]}}
SCRIPT = [{"at_s": at_s, "agent": agent} for at_s, agent in ((12.5, 2), (14, 1), (17, 3), (20, 1))]
BUSY: dict[str, Any] = {"agents": 3, "network": {"loss": 0.0}, "events": {"source": "scripted", "script": SCRIPT}}
WRONG = {2: {"offset_s": 50, "drift": 0.01}}
EVENT = "if 'event_id' in given:\n    "


@pytest.fixture(autouse=True)
def narrow_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line_program, "MAX_ANSWER_BYTES", 1 << 20)
    monkeypatch.setattr(_foreign_agent, "MAX_TIMERS_PER_S", 50)


def run_with(tmp_path: Path, code: str, **keys: Any) -> Run:
    """Play a run in which agent 2 is a small program that runs `code` before each answer."""
    one = played_by({2: small(tmp_path, code)}, **{**SHORT, **keys})
    return run(one, 1, tmp_path / "run", SilentProgress(), "sim")


@pytest.mark.parametrize(
    ("code", "outcome", "sentence"),
    [
        (EVENT + "sys.exit(3)", "crashed", "ended by itself with status 3 after it received an event at 12.5 s"),
        (EVENT + "os.kill(os.getpid(), 9)", "crashed", "was ended by SIGKILL after it received an event at 12.5 s"),
        (
            EVENT + "time.sleep(9)",
            "hung",
            "did not answer within 1 s (with a whole line, flushed) after it received an event",
        ),
        (EVENT + "print('ready')", "crashed", "answered an event at 12.5 s with a line that is not JSON"),
        (EVENT + "said = [1]", "crashed", "answered an event at 12.5 s with a line that is not a JSON object: '[1]'"),
        (EVENT + "said = {}", "crashed", "answered an event at 12.5 s without a list `sent`: '{}'"),
        (EVENT + "print('x' * (2 << 20), end='')", "crashed", "answers with a line of more than 1 MiB"),
        (EVENT + "del said['timer']", "crashed", "without a number of mission seconds, or null, as `timer`"),
        (EVENT + "said['timer'] = float('nan')", "crashed", "with a line that is not JSON (expected value"),
        (EVENT + "said['timer'] = 10 ** 400", "crashed", "not a number of mission seconds, or null, as `timer`"),
        (EVENT + "said['timer'] = '1'", "crashed", "with the timer '1', not a number of mission seconds"),
        (
            "said['timer'] = given['t'] + 1e-9 * ('timer' in given or not number)",
            "hung",
            "a timer that expires repeatedly",
        ),
        ("said['timer'] = 1", "hung", "has a timer that expires repeatedly without end at 1 s"),
        (EVENT + "said['sent'] = ['?']", "crashed", "with a datagram that is not base64: '?'"),
        (EVENT + "said['sent'] = ['AA=='] * 2000", "crashed", "with 2000 datagrams at once"),
        (EVENT + "said['sent'] = ['A' * 100000]", "crashed", "with a datagram of 75000 bytes, more than UDP carries"),
        (EVENT + "del said['trace']", "crashed", "without the list `trace`, which its mission requires"),
        (EVENT + "said['trace'] = [{'t': 1}]", "crashed", "with `trace.0`, which is not a line of a trace"),
        (
            EVENT + "said['trace'] = [{'t': 1, 'dropped': 'x', 'datagram': ''}]",
            "crashed",
            "wrote t=1.0 into its trace of an input at 12.5 s",
        ),
        (EVENT + "print(json.dumps(said))", "crashed", "wrote an unexpected line"),
        (EVENT + "said = {'error': 'no, not I'}", "crashed", "refused an event at 12.5 s: no, not I"),
        ("if given.get('command') == 'status': said['answer'] = {'ok': True}", "crashed", "lacks a valid `started`"),
        (
            "if given.get('command') == 'export': said['answer'] = 3",
            "crashed",
            "gave no `answer` to the command export",
        ),
        (
            EXPORT + "if given.get('command') == 'export': said['answer']['chain'] = [1]",
            "crashed",
            "its answer to the command export lacks a valid `chain.0`",
        ),
        (
            EXPORT + "if given.get('command') == 'export': said['answer']['agent_id'] = 7",
            "crashed",
            "answered the command export with the export of agent 7",
        ),
        (
            EXPORT + "if given.get('command') == 'export': said['answer']['inception']['block_data'] = 'AA=='",
            "crashed",
            "answered the command export with the chain of another mission",
        ),
        (
            "if given.get('command') == 'export': said['sent'] = ['AA==']",
            "crashed",
            "sent messages, set a timer or ran a handler",
        ),
        (EVENT + "said = {'error': 'no such event', 'unsupported': True}", "not supported", "no such event"),
    ],
)
def test_error_of_an_agent_is_one_sentence_in_the_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, outcome: str, sentence: str
) -> None:
    if "sleep" in code:
        monkeypatch.setattr(line_program, "ANSWER_LIMIT_S", 1.0)
    finished = run_with(tmp_path, "import os, time\n" + code)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (sentence in record["outcome_detail"]) and "agent 2" in record["outcome_detail"], record["outcome_detail"]
    assert record["agents"]["2"]["outcome"] == outcome
    assert record["agents"]["1"]["outcome"] == "exported"
    assert finished.exit_status == (3 if outcome == "not supported" else 1)


ENDS_IN_PHASE_TWO = """
import os, sys
from ucp import virtual
answer = virtual.VirtualAgent.answer
def dying(agent):
    said = answer(agent)
    return said if '"handler":"reconcile_phase_2"' not in said else os._exit(7)
virtual.VirtualAgent.answer = dying
virtual.main()
"""


def test_crash_of_an_agent_violates_no_characteristic(tmp_path: Path) -> None:
    (tmp_path / "dying.py").write_text(ENDS_IN_PHASE_TWO)
    dying = [sys.executable, str(tmp_path / "dying.py")]
    finished = run(played_by({2: dying}, network={"loss": 0.3}), 1, tmp_path / "run", SilentProgress(), "sim")
    assert "agent 2 ended by itself with status 7" in str(finished.played.outcome_detail)
    assert finished.exit_status == 1 and not finished.result.bad


DIES = EVENT + "sys.exit(3)"


def test_dead_program_does_not_end_the_run_for_others(tmp_path: Path) -> None:
    finished = run_with(tmp_path, DIES, capture=True, clocks=WRONG, **BUSY)
    assert finished.exit_status == 1
    assert not finished.result.bad, "messages to a dead agent are not lost ones"
    record = finished.record
    assert record.mission_s is not None and record.mission_s >= 30
    assert [(failure.at_s, failure.incarnation) for failure in record.agents["2"].failures] == [(12.5, 1)]
    sentence = "ended by itself with status 3 after it received an event at 12.5 s"
    assert sentence in str(record.outcome_detail) and sentence in (tmp_path / "run/report.html").read_text()
    for agent in ("1", "3"):
        last = json.loads((tmp_path / f"run/agents/{agent}.trace.jsonl").read_text().splitlines()[-1])
        assert record.agents[agent].outcome == "exported" and last["t"] > 15


@pytest.mark.parametrize("tracing", [True, False])
def test_dead_program_is_a_finding_of_a_run_in_memory(tmp_path: Path, tracing: bool) -> None:
    simulated = simulate(played_by({2: small(tmp_path, DIES)}, **{**SHORT, **BUSY}), 1, tracing=tracing)
    assert simulated.played.mission_s >= 30
    assert [simulated.played.agents[agent].outcome for agent in "123"] == ["exported", "crashed", "exported"]
    assert simulated.result.wrong == (ENDED,)
    (finding,) = simulated.result.judgements[ENDED].evidence
    assert finding.agent_id == 2
    assert finding.detail.startswith("crashed: it ended by itself with status 3 after it received an event at 12.5 s")


def test_program_that_fails_at_its_export_is_a_finding_in_memory(tmp_path: Path) -> None:
    simulated = simulate(played_by({2: small(tmp_path)}, **{**SHORT, **BUSY}), 1, tracing=True)
    assert "gave no `answer` to the command export" in simulated.result.judgements[ENDED].evidence[0].detail
    assert [*simulated.evidence.exports] == [1, 3]


ENDS_AT_FOURTH_EVENT = """
import json, os
from ucp import virtual
answer, events = virtual.VirtualAgent.answer, 0
def dying(agent):
    global events
    said = answer(agent)
    events += '"trigger":{"event"' in said
    return said if events < 4 else os._exit(7)
virtual.VirtualAgent.answer = dying
virtual.main()
"""


def test_dead_program_reboots_with_its_disk(tmp_path: Path) -> None:
    (tmp_path / "dying.py").write_text(ENDS_AT_FOURTH_EVENT)
    script = [{"at_s": 5.0 * number, "agent": 2, "bytes": 200} for number in range(1, 5)]
    one = played_by(
        {2: [sys.executable, str(tmp_path / "dying.py")]},
        agents=2,
        duration_s=100,
        settings={"max_block_bytes": 300},
        network={"loss": 0.0},
        events={"source": "scripted", "script": script},
        timeline=[{"at_s": 30, "reboot": [2], "down_s": 2, "disk": "kept"}],
    )
    finished = run(one, 1, tmp_path / "run", SilentProgress(), "sim")
    agent = finished.record.agents["2"]
    assert [failure.at_s for failure in agent.failures] == [20]
    assert (agent.outcome, agent.restarts, agent.reboots) == ("exported", 0, 1)
    completed = json.loads((tmp_path / "run/agents/2.chain.json").read_text())["completed"]
    assert len(completed) == 3
    assert not finished.result.bad


def test_reboot_starts_a_dead_program_again(tmp_path: Path) -> None:
    reboot = [{"at_s": 16, "reboot": [2], "down_s": 2, "disk": "lost"}]
    dies_before_the_reboot = EXPORT + EVENT + "sys.exit(3) if given['t'] < 16 else None"
    finished = run_with(tmp_path, dies_before_the_reboot, timeline=reboot, **BUSY)
    agent = finished.record.agents["2"]
    assert (agent.outcome, [failure.incarnation for failure in agent.failures]) == ("exported", [1])
    assert finished.exit_status == 1
    assert finished.result.judgements["steps"].verdict == "not applicable"
    assert "status 3" in finished.result.judgements["steps"].reason


def test_program_that_dies_at_its_start_leaves_the_others(tmp_path: Path) -> None:
    finished = run_with(tmp_path, "sys.exit(3)", **BUSY)
    assert [finished.record.agents[agent].outcome for agent in "123"] == ["exported", "crashed", "exported"]
    assert finished.record.mission_s is not None and finished.record.mission_s >= 30


def test_agent_with_growing_number_of_datagrams_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of the two agents answers each datagram with two datagrams."""
    monkeypatch.setattr(_foreign_agent, "MAX_SENT_PER_S", 200)
    code = EVENT + "said['sent'] = ['AA==']\nif 'datagram' in given:\n    said['sent'] = ['AA==', 'AA==']"
    one = played_by(small(tmp_path, code), **SHORT)
    ended = simulate(one, 1, tracing=True).result.judgements[ENDED]
    assert ended.reason == "agent 2 crashed; agent 1 crashed"
    assert re.match(r"crashed: it sent more than 200 datagrams within a second, at 1\d", ended.evidence[0].detail)


def test_stray_datagram_reaches_other_agents(tmp_path: Path) -> None:
    """The agent sends the first half of a header, and a message in the name of another agent."""
    forged = in_base64(encode(1, 0, BlockAddRequest(bytes(32), bytes(32))))
    code = EVENT + f"said['sent'] = ['VUMB', '{forged}']"
    run_with(tmp_path, code, agents=3, duration_s=20)
    lines = [json.loads(line) for line in (tmp_path / "run/agents/3.trace.jsonl").read_text().splitlines()]
    assert [line["datagram"] for line in lines if "dropped" in line] == ["VUMB"]
    assert [line["trigger"]["from"] for line in lines if "trigger" in line] == [1]


def test_agent_that_does_not_end_is_killed(tmp_path: Path) -> None:
    run_with(tmp_path, "import atexit, time\nif number == 0:\n    atexit.register(time.sleep, 99)")
    assert not living(tmp_path)


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("import time; said['now'] = int(time.time())", "it may read a clock, draw random numbers"),
        ("import os; said['pid'] = os.getpid()", "it may read a clock, draw random numbers"),
        (
            "given.setdefault('seen', globals().setdefault('seen', number)); said['n'] = number",
            "an earlier incarnation",
        ),
    ],
)
def test_nondeterministic_agent_is_named(tmp_path: Path, code: str, why: str) -> None:
    finished = run_with(tmp_path, EXPORT + code)
    detail = str(finished.played.outcome_detail)
    assert finished.exit_status == 1
    assert "agent 2 is not deterministic: given" in detail and why in detail, detail


def test_agent_without_virtual_time_is_not_supported(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedError, match=r"not supported by agent 2 .*with --virtual it ends with status 2"):
        simulate(played_by({2: ["/bin/sh", "-c", "exit 2"]}, **SHORT), 1)
