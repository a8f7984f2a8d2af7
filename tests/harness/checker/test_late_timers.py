"""Test late timers: a delay that the slowness of the machine explains is no deviation, and any other delay is one.

Test the lateness of vote timers with artificial traces.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from harness.archive.archive import RunArchive
from harness.archive.run_journals import LAG_FILE, LagLine, MeasuredLag
from harness.archive.traces import Trace, TraceHeader
from harness.checker import check, gather
from harness.checker.judgement import Judgement
from harness.checker.timer_lag import ENOUGH, timer_lag
from harness.play.progress import SilentProgress
from harness.run.run import Run, run
from harness.run.simulate import simulate
from tests.harness.mission import edit, edit_lines
from tests.harness.virtual import scenario
from ucp.trace import HandlerRun, StateSummary
from ucp.trigger import UnknownTrigger

OFTEN = {"source": "random", "mean_s": 2}
LATE_S = 0.5
VOTES_LATE = """
import sys
from ucp import node
from ucp.timers import Timer

start = Timer.start
Timer.start = lambda timer, now, duration_s: start(timer, now, duration_s + 15 * (timer.name == "voting"))
sys.exit(node.main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Play a run in which agents vote half a second longer than the vote timer of 10 s in the headers of their
    traces.
    """
    asked = scenario(agents=3, duration_s=150, events=OFTEN, settings={"vote_timeout_s": 10 + LATE_S})
    directory = run(asked, 1, tmp_path_factory.mktemp("late") / "run", SilentProgress(), backend="sim").directory

    def claim_ten_seconds(lines: list[dict[str, Any]]) -> None:
        lines[0]["settings"]["vote_timeout_s"] = 10.0
        lines[0]["clock"]["epoch_us"] = 1  # a run in real time
        for line in lines:
            line.pop("started", None)

    for agent in "123":
        edit_lines(directory / f"agents/{agent}.trace.jsonl", claim_ten_seconds)
    return directory


def judged(late: Path, tmp_path: Path, *, speedup: float = 1.0, lag: list[dict[str, Any]] | None = None) -> Judgement:
    """Judge the steps of a run. `speedup` replaces the speedup of mission time, and the delays of the machine replace
    the measured ones.
    """
    directory = tmp_path / "run"
    if not directory.exists():
        shutil.copytree(late, directory)
    for agent in "123":
        edit_lines(directory / f"agents/{agent}.trace.jsonl", lambda lines: lines[0]["clock"].update(speedup=speedup))
    if lag is not None:
        (directory / LAG_FILE).write_text("".join(json.dumps(line) + "\n" for line in lag))
    return check(gather(RunArchive(directory))).beside["steps"]


def measured(machine_s: float = 0.0, *, busy_s: float = 0.0, agents: str = "123") -> list[dict[str, Any]]:
    """Return lines of the lag file with the same delays for the whole run. Each line covers two mission seconds."""
    figures = {"machine_s": machine_s, "busy_s": dict.fromkeys(agents, busy_s)}
    return [{"from_s": at, "until_s": at + 2, **figures} for at in range(0, 2000, 2)]


def test_timer_later_than_the_measured_lag_is_a_deviation(late: Path, tmp_path: Path) -> None:
    found = judged(late, tmp_path, lag=measured(0.1, busy_s=0.05))
    assert found.verdict == "deviates"
    assert {finding.agent_id for finding in found.evidence} == {1, 2, 3}
    assert {finding.handler for finding in found.evidence} == {"vote_timer_expiration"}
    assert "it ran 0.5 s after the voting timer expired, but the measured lag explains only" in found.evidence[0].detail


@pytest.mark.parametrize("lag", [measured(0.6), measured(busy_s=0.6), measured(0.3, busy_s=0.3), measured(agents="")])
def test_timer_that_the_lag_explains_is_no_deviation(late: Path, tmp_path: Path, lag: list[dict[str, Any]]) -> None:
    assert judged(late, tmp_path, lag=lag).verdict == "as specified"


def test_late_timer_in_virtual_time_is_a_deviation(late: Path, tmp_path: Path) -> None:
    shutil.copytree(late, tmp_path / "run")
    for agent in "123":
        edit_lines(tmp_path / f"run/agents/{agent}.trace.jsonl", lambda lines: lines[0]["clock"].update(epoch_us=0))
    found = judged(late, tmp_path)
    assert found.verdict == "deviates"
    assert "it ran 0.5 s after the voting timer expired, and virtual time has no lag" in found.evidence[0].detail


def test_timer_that_the_scenario_delays_is_no_deviation(tmp_path: Path) -> None:
    asked = scenario(agents=3, duration_s=150, events=OFTEN, lateness={1: "0+0.5 3+2"})
    result = run(asked, 1, tmp_path / "run", SilentProgress(), backend="sim").result
    assert result.beside["steps"].verdict == "as specified", result.beside["steps"].evidence
    assert simulate(asked, 1, tracing=True).result.beside["steps"].verdict == "as specified"


def test_delay_of_seconds_that_the_lag_explains_is_no_deviation(late: Path, tmp_path: Path) -> None:
    """A handler is late by 2.5 s of wall time. Without a measured lag of this length, the delay is a deviation."""
    found = judged(late, tmp_path, speedup=0.2, lag=measured(0.1))
    assert found.verdict == "deviates"
    assert any("it did not run, although the voting timer expired" in each.detail for each in found.evidence)
    assert judged(late, tmp_path, speedup=0.2, lag=measured(3.0)).verdict == "as specified"
    assert check(gather(RunArchive(tmp_path / "run"))).characteristics["1"].verdict == "holds"


def test_mean_shows_an_error_that_single_timers_do_not_show(late: Path, tmp_path: Path) -> None:
    found = judged(late, tmp_path, speedup=20, lag=measured(0.005))
    assert found.verdict == "deviates"
    assert "voting timers ran 0.5 s after they expired on average" in found.evidence[0].detail
    assert judged(late, tmp_path, speedup=20, lag=measured(0.02)).verdict == "as specified"


def test_timer_of_a_paused_agent_is_no_deviation(late: Path, tmp_path: Path) -> None:
    shutil.copytree(late, tmp_path / "run")
    pause = {"at_s": 0.0, "what": "pause", "detail": "agents 1 2 3", "agents": [1, 2, 3]}
    edit(tmp_path / "run" / "run.json", lambda record: record["faults"].append(pause))
    assert judged(late, tmp_path, lag=measured()).verdict == "as specified"


def test_reason_reports_that_no_lag_is_recorded(late: Path, tmp_path: Path) -> None:
    found = judged(late, tmp_path)
    assert found.verdict == "as specified"
    assert "the lag of the machine is not recorded for timers, so they may be up to 1 s" in found.reason
    assert judged(late, tmp_path, lag=[{"at_s": 0}]).reason == found.reason
    begins_late = judged(late, tmp_path, lag=measured(1.0)[30:]).reason
    assert "timers, so they may be" in begins_late
    assert begins_late != found.reason
    assert judged(late, tmp_path, lag=measured(1.0)).reason.endswith("Algorithms 1 to 20")


def test_lag_outside_the_measured_time_is_unknown() -> None:
    lag = MeasuredLag([LagLine.model_validate(line) for line in measured(0.1, busy_s=0.2)[1:3]])
    assert lag.explains(1, 2.0, 3.0) == pytest.approx(0.3)
    assert lag.explains(1, 3.0, 5.0) == pytest.approx(0.6)
    assert lag.explains(1, 1.0, 3.0) is None
    assert lag.explains(1, 5.0, 6.5) is None
    assert lag.explains(4, 3.0, 5.0) is None


@pytest.fixture
def busy_machine() -> Iterator[None]:
    """Keep all processors busy with twice as many processes."""
    burning = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1))]
    yield
    for process in burning:
        process.kill()
        process.wait()


def played(tmp_path: Path, **keys: Any) -> Run:
    asked = scenario(agents=3, duration_s=80, speedup=20, vehicles={"kind": "none"}, events=OFTEN, **keys)
    return run(asked, 1, tmp_path / "run", SilentProgress(), backend="process")


@pytest.mark.lab
def test_busy_machine_accuses_no_agent(tmp_path: Path, busy_machine: None) -> None:
    timeline = [{"at_s": 30, "pause": [1]}, {"at_s": 40, "resume": [1]}]
    found = played(tmp_path, timeline=timeline).result
    assert found.beside["steps"].verdict == "as specified", found.beside["steps"]
    assert found.beside["records"].verdict == "agree", found.beside["records"]


@pytest.mark.lab
@pytest.mark.any_user
def test_agent_with_a_longer_voting_timer_is_found(tmp_path: Path) -> None:
    program = tmp_path / "agent.py"
    program.write_text(VOTES_LATE)
    found = played(tmp_path, agent_command={2: [sys.executable, str(program)]}).result.beside["steps"]
    assert found.verdict == "deviates"
    assert {finding.agent_id for finding in found.evidence} == {2}


def _run(t: float, handler: str, branch: str, reconciling: bool = False) -> HandlerRun:
    state = StateSummary(chain=0, deque=0, stack=0, reconciling=reconciling, idle=False, top="")
    return HandlerRun(t, handler, 1, UnknownTrigger({}), branch, [], [], state)


def _votes(*late_s: float, reconciling: bool = False) -> Trace:
    """Return the trace of an agent whose vote timers of 10 s expired late by these numbers of seconds."""
    header = TraceHeader(agent_id=1, roster=[1], settings={"vote_timeout_s": 10.0}, clock={})
    runs = [
        run
        for number, late in enumerate(late_s)
        for run in (
            _run(100.0 * number, "process_next_deque_block", "proposed"),
            _run(100.0 * number + 1, "receive_vote", "counted", reconciling),
            _run(100.0 * number + 10 + late, "vote_timer_expiration", "committed"),
        )
    ]
    return Trace(header, runs)


@pytest.mark.parametrize(("late_s", "tolerable"), [(0.2, True), (0.6, False)])
def test_lateness_is_that_of_the_latest_twentieth(late_s: float, tolerable: bool) -> None:
    found = timer_lag([_votes(*[0.01] * 36), _votes(*[late_s] * 4)])
    assert found is not None
    assert found.late_s == pytest.approx(late_s)
    assert found.asked_s == 10.0
    assert found.tolerable is tolerable


def test_one_late_timer_of_many_is_tolerable() -> None:
    found = timer_lag([_votes(*[0.01] * 99, 5.0)])
    assert found is not None
    assert found.tolerable


@pytest.mark.parametrize(("machine_s", "tolerable"), [(0.001, True), (1.0, False)])
def test_lateness_beyond_the_measured_lag_is_not_attributed_to_the_machine(machine_s: float, tolerable: bool) -> None:
    votes = _votes(*[5.0] * 40)
    votes.header.clock["speedup"] = 20
    line = {"from_s": 0, "until_s": 10_000, "machine_s": machine_s, "busy_s": {"1": 0.0}}
    found = timer_lag([votes], MeasuredLag([LagLine.model_validate(line)]))
    assert found is not None
    assert found.tolerable is tolerable


def test_too_few_votes_give_no_result() -> None:
    assert timer_lag([_votes(*[5.0] * (ENOUGH - 1))]) is None


def test_vote_paused_by_a_reconcile_does_not_count() -> None:
    assert timer_lag([_votes(*[50.0] * 100, reconciling=True)]) is None
