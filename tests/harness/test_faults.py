"""What a scenario can do to agents: kill, restart, pause, resume, and clocks that are wrong."""

from itertools import pairwise
from random import Random
from typing import Any

import pytest
from pydantic import ValidationError

from harness.seeds import agent_seed
from harness.simulate import Simulated, simulate
from tests.harness.virtual import scenario
from ucp.events import RandomEvents


def played(timeline: list[dict[str, Any]], **keys: Any) -> Simulated:
    keys = {"duration_s": 600, "events": {"source": "random", "mean_s": 10}, **keys}
    return simulate(scenario(timeline=timeline, **keys), 4, tracing=True)


def verdicts(simulated: Simulated) -> set[str]:
    return {one.verdict for one in simulated.result.characteristics.values()}


def test_a_killed_agent_is_gone_with_all_that_it_held() -> None:
    simulated = played([{"at_s": 300, "kill": [2, 5]}], final_reconcile=True)
    assert sorted(simulated.evidence.exports) == [1, 3, 4]
    assert simulated.played.agents["2"]["outcome"] == "killed"
    assert max(run.t for run in simulated.evidence.traces[2].runs) <= 300
    assert verdicts(simulated) == {"holds"}
    blocks, left = simulated.result.figures["blocks"], len(simulated.evidence.exports[1].chain)
    gone = f"; {blocks - left} more were gone with the agents that were killed" if blocks != left else ""  # type: ignore[operator]
    assert simulated.result.characteristics["5"].reason == f"all {left} completed blocks are in every chain{gone}"


def test_blocks_that_only_a_killed_agent_held_are_told_and_no_violation() -> None:
    alone = [{"at_s": 0, "partition": [[1], [2, 3]]}, {"at_s": 400, "kill": [1]}, {"at_s": 401, "heal": True}]
    simulated = played(alone, agents=3, final_reconcile=True)
    everywhere = simulated.result.characteristics["5"]
    assert everywhere.verdict == "holds"
    assert "more were gone with the agents that were killed" in everywhere.reason
    assert simulated.result.figures["copies_min"] == 0


def test_a_restarted_agent_begins_with_nothing_and_gets_everything_back() -> None:
    simulated = played([{"at_s": 300, "kill": [2]}, {"at_s": 330, "restart": [2]}], final_reconcile=True)
    trace = simulated.evidence.traces[2]
    first, second = ([run for _, run in life] for life in trace.lives())
    assert max(run.t for run in first) <= 300 < 330 <= min(run.t for run in second)
    assert second[0].state.chain == 0
    completed = simulated.evidence.exports[2].completed
    assert {run.changes[0][1] for run in first if run.branch == "full"}.isdisjoint(completed)
    assert len(simulated.evidence.exports[2].chain) >= 30
    assert verdicts(simulated) == {"holds"}


def test_a_restarted_agent_hears_nothing_that_was_sent_before() -> None:
    slow = {"delay": 10.0}
    simulated = played([{"at_s": 300, "kill": [2]}, {"at_s": 301, "restart": [2]}], network=slow)
    heard = [run.t for run in simulated.evidence.traces[2].runs if "message" in run.trigger]
    assert not [t for t in heard if 300 < t < 311]
    assert [t for t in heard if t < 300 or t > 311]
    assert agent_seed(4, 2) != agent_seed(4, 2, life=2)


def test_a_restarted_agent_logs_its_own_events_only() -> None:
    """What its first life was about to log died with it."""
    simulated = played([{"at_s": 300, "kill": [2]}, {"at_s": 300.5, "restart": [2]}])
    source = RandomEvents(Random(agent_seed(4, 2, life=2)), mean_s=10)
    expected = [t for t in (300.5 + source.next()[0] for _ in range(100)) if t <= 600]
    assert [run.t for run in simulated.evidence.traces[2].runs if run.t > 300 and "event" in run.trigger] == expected


def test_without_traces_a_restarted_agents_blocks_are_known_all_the_same() -> None:
    one = scenario(
        duration_s=600,
        events={"source": "random", "mean_s": 10},
        timeline=[{"at_s": 300, "kill": [2]}, {"at_s": 330, "restart": [2]}],
    )
    assert simulate(one, 4).result.characteristics["4"].verdict == "holds"


def test_a_paused_agent_handles_what_waited_when_it_resumes() -> None:
    simulated = played([{"at_s": 200, "pause": [3]}, {"at_s": 320, "resume": [3]}], final_reconcile=True)
    times = [run.t for run in simulated.evidence.traces[3].runs]
    assert not [t for t in times if 200 < t < 320]
    assert times.count(320) > 5
    assert verdicts(simulated) == {"holds"}


def test_a_vote_may_last_longer_while_its_agent_is_paused() -> None:
    script = [{"at_s": at_s, "agent": 1} for at_s in (1, 2, 3)]
    pause = [{"at_s": 5, "pause": [1]}, {"at_s": 60, "resume": [1]}]
    simulated = played(pause, events={"source": "scripted", "script": script}, duration_s=100)
    assert [run.t for run in simulated.evidence.traces[1].runs if run.handler == "vote_timer_expiration"] == [60]
    assert verdicts(simulated) == {"holds"}


def test_an_agent_that_stays_paused_leaves_the_run_unsettled() -> None:
    simulated = played([{"at_s": 500, "pause": [3]}])
    assert not simulated.played.settled


@pytest.mark.parametrize(("offset_s", "drift"), [(-1000, 0.0), (1000, 0.0), (0, 0.01), (-50, -0.2)])
def test_agents_agree_whatever_their_clocks_show(offset_s: float, drift: float) -> None:
    """Timers run at the drifting clock's pace, and timestamps are the clock's: 0 before the run's start."""
    simulated = played([], clocks={2: {"offset_s": offset_s, "drift": drift}}, final_reconcile=True)
    assert verdicts(simulated) == {"holds"}
    own = [block for block in simulated.evidence.exports[1].chain if block.agent_id == 2]
    others = [block for block in simulated.evidence.exports[1].chain if block.agent_id == 1]
    assert max(block.timestamp_us for block in own) <= max(0, (offset_s + 600 * (1 + drift)) * 1e6) + len(own)
    assert max(block.timestamp_us for block in others) <= 600e6
    votes = [
        run
        for run in simulated.evidence.traces[2].runs
        if run.handler in ("process_next_deque_block", "vote_timer_expiration")
    ]
    spans = [
        end.t - begin.t
        for begin, end in pairwise(votes)
        if begin.branch == "proposed" and end.handler == "vote_timer_expiration"
    ]
    assert spans
    assert all(span == pytest.approx(10 / (1 + drift)) for span in spans)


@pytest.mark.parametrize(
    ("timeline", "sentence"),
    [
        ([{"at_s": 1, "restart": [1]}], "timeline.0.restart: agent 1 is running then, not killed"),
        ([{"at_s": 1, "kill": [1]}, {"at_s": 2, "pause": [1]}], "timeline.1.pause: agent 1 is killed then"),
        ([{"at_s": 2, "resume": [1]}], "timeline.0.resume: agent 1 is running then, not paused"),
        ([{"at_s": 2, "kill": [1, 1]}], "agent 1 is killed then"),
        ([{"at_s": 2, "kill": [9]}], "timeline.0.kill names vehicle 9, which does not exist"),
        ([{"at_s": 2, "kill": []}], "at least 1 item"),
        ([{"at_s": 2, "kill": [1], "heal": True}], "needs exactly one of"),
    ],
)
def test_faults_that_cannot_be_played_are_refused(timeline: list[dict[str, Any]], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        scenario(timeline=timeline)
