"""Test the setting `answer_spread_s`, which delays answers."""

import pytest

from harness.checker.recorded_inputs import sent_at
from harness.scenario import Scenario
from ucp._answer_spread import answer_wait_s
from ucp.agent import Agent
from ucp.block import Block
from ucp.messages import BlockAddRequest, BlockAddResponse, ChainContainQuery, decode, encode
from ucp.settings import Settings
from ucp.trace import HandlerRun

SPREAD_S = 2.0


def asked_agent(spread_s: float = SPREAD_S) -> Agent:
    """Return an agent that has received two queries at mission second 1."""
    agent = Agent(7, (1, 2, 7), b"inception", Settings(answer_spread_s=spread_s))
    top = agent.state.chain.top_chain_hash
    block = Block(1, 1, b"data")
    agent.receive_datagram(encode(1, 0, BlockAddRequest(block.block_hash, top)), 1.0)
    agent.receive_datagram(encode(2, 0, ChainContainQuery(top)), 1.0)
    return agent


def test_answers_are_sent_at_once_without_a_spread() -> None:
    agent = asked_agent(0.0)
    assert len(agent.datagrams_to_send()) == 2
    assert agent.next_timer() is None


def test_answer_is_sent_after_its_own_wait() -> None:
    agent = asked_agent()
    assert agent.datagrams_to_send() == []
    for _ in range(2):
        due_s = agent.next_timer()
        assert due_s is not None
        agent.handle_timer(due_s - 1e-6)
        assert agent.datagrams_to_send() == []
        agent.handle_timer(due_s)
        (datagram,) = agent.datagrams_to_send()
        assert due_s == 1.0 + answer_wait_s(datagram, SPREAD_S)
    assert agent.next_timer() is None


def test_waits_fill_the_spread_evenly() -> None:
    waits = [answer_wait_s(encode(7, number, BlockAddResponse(b"\0" * 32, True)), SPREAD_S) for number in range(2000)]
    assert min(waits) >= 0 and max(waits) < SPREAD_S
    tenths = [sum(int(wait_s / SPREAD_S * 10) == tenth for wait_s in waits) for tenth in range(10)]
    assert min(tenths) > 140 and max(tenths) < 260  # 200 in each, and a standard deviation of 13


def test_trace_has_the_answer_when_the_handler_runs() -> None:
    agent = asked_agent()
    runs = [entry for entry in agent.trace() if isinstance(entry, HandlerRun)]
    assert [(run.t, len(run.sent)) for run in runs] == [(1.0, 1), (1.0, 1)]


def test_checker_computes_the_same_time_of_sending() -> None:
    agent = asked_agent()
    runs = [entry for entry in agent.trace() if isinstance(entry, HandlerRun)]
    expected = {run.sent[0].seq: sent_at(run, run.sent[0], SPREAD_S) for run in runs}
    agent.datagrams_to_send()
    for _ in runs:
        due_s = agent.next_timer()
        assert due_s is not None
        agent.handle_timer(due_s)
        (datagram,) = agent.datagrams_to_send()
        assert expected[decode(datagram).sequence] == due_s


def test_answers_that_are_due_together_are_sent_in_order_of_their_times() -> None:
    agent = asked_agent()
    agent.datagrams_to_send()
    agent.begin_reconcile(1.0)
    agent.datagrams_to_send()
    agent.handle_timer(1.0 + Settings().phase1_timeout_s)
    answers = [datagram for datagram in agent.datagrams_to_send() if decode(datagram).message.NAME.endswith("Response")]
    assert len(answers) == 2
    waits = [answer_wait_s(answer, SPREAD_S) for answer in answers]
    assert waits == sorted(waits)


@pytest.mark.parametrize("spread_s", [-1.0, 5.0, float("nan"), float("inf"), True, "1"])
def test_impossible_spread_is_refused(spread_s: object) -> None:
    with pytest.raises(
        ValueError, match="answer_spread_s must be at least 0 seconds, less than each of the four timers"
    ):
        Settings(answer_spread_s=spread_s)  # type: ignore[arg-type]


def test_scenario_has_the_setting() -> None:
    scenario = Scenario.model_validate({"name": "spread", "agents": 3, "settings": {"answer_spread_s": 0.5}})
    assert scenario.settings.to_json()["answer_spread_s"] == 0.5
    assert "answer_spread_s" not in Settings().to_json()
