"""Test runs in which agents delay their answers."""

from typing import Any

import pytest

from harness.checker.evidence import Evidence
from harness.checker.recorded_inputs import ANSWERS
from harness.run.simulate import simulate
from harness.scenario import Scenario
from netem.medium import LATENCY
from ucp.trigger import MessageTrigger

SPREAD_S = 0.5
SETTINGS = {"answer_spread_s": SPREAD_S, "max_block_bytes": 300}
QUIET: dict[str, Any] = {"name": "spread", "agents": 4, "duration_s": 120, "settings": SETTINGS}
ROUGH: dict[str, Any] = {
    **QUIET,
    "network": {"loss": 0.1},
    "timeline": [{"at_s": 30, "partition": [[1, 2]], "for_s": 30}, {"at_s": 80, "kill": [4]}],
}


def waits(evidence: Evidence) -> list[float]:
    """Return, for each answer, the mission seconds from its sending until the receiver handles it."""
    runs = [(agent_id, run) for agent_id, trace in evidence.traces.items() for run in trace.runs]
    answered = {(agent_id, sent.seq): run.t for agent_id, run in runs for sent in run.sent if sent.message in ANSWERS}
    triggers = [(run.t, run.trigger) for _, run in runs if isinstance(run.trigger, MessageTrigger)]
    return [
        at_s - answered[trigger.sender, trigger.sequence] for at_s, trigger in triggers if trigger.message in ANSWERS
    ]


@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize("deliver_all", [False, True])
def test_judge_finds_nothing_wrong(seed: int, deliver_all: bool) -> None:
    result = simulate(Scenario.model_validate(ROUGH), seed, tracing=True, deliver_all=deliver_all).result
    assert result.beside["steps"].verdict == "as specified"
    assert result.beside["records"].verdict == "agree"


def test_answers_arrive_after_their_wait() -> None:
    waited = waits(simulate(Scenario.model_validate(QUIET), 1, tracing=True).evidence)
    assert len(waited) > 20
    assert max(waited) > SPREAD_S / 2
    assert max(waited) <= SPREAD_S + LATENCY.mean_s + LATENCY.jitter_s


def test_judge_finds_answers_that_do_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ucp._answer_spread.answer_wait_s", lambda datagram, spread_s: 0.0)
    records = simulate(Scenario.model_validate(QUIET), 1, tracing=True).result.beside["records"]
    assert records.verdict == "contradict"
    assert "before it was sent" in records.evidence[0].detail
