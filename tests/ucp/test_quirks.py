"""Test that agents with a deliberate error make this error and are otherwise correct."""

from functools import cache
from random import Random

import pytest

from harness.archive.traces import Trace
from harness.run.simulate import simulate
from tests.harness.virtual import scenario
from tests.ucp.test_handlers import done
from ucp.agent import HANDLERS, Agent
from ucp.core import Core
from ucp.events import LoggableEvent
from ucp.messages import BlockAddResponse
from ucp.quirks import CRASHED, QUIRKS, active_quirks, check_quirk, wrong_handlers

CRASHING = {"break_off_commit", "break_off_broadcast", "crash_on_tie"}
"""Deliberate errors that raise an exception."""
INDIRECTLY_CRASHING = {
    "keep_committed_block",
    "commit_others_twice",
    "skip_phase2",
    "ask_for_what_is_held",
    "take_any_block",
}
"""Deliberate errors that lead to a state in which a correct handler raises an exception."""


def value(quirk: str) -> float | bool:
    return 0.5 if QUIRKS[quirk].chance else True


@cache
def traces(seed: int, quirk: str | None) -> dict[int, Trace]:
    """Return the traces of a swarm with this error. The mission has loss, duplicates, diverged chains and long
    deques.
    """
    difficult = scenario(
        duration_s=450,
        network={"loss": 0.25, "duplicate": 0.2},
        events={"source": "random", "mean_s": 15},
        timeline=[{"at_s": 100, "partition": [[1, 2], [3, 4, 5]]}, {"at_s": 250, "heal": True}],
        settle={"limit_s": 100},
        quirks={quirk: value(quirk)} if quirk else {},
    )
    return simulate(difficult, seed, tracing=True, deliver_all=True).evidence.traces


def lines(traces: dict[int, Trace]) -> list[str]:
    return [run.to_line() for trace in traces.values() for run in trace.runs]


@pytest.mark.parametrize("quirk", QUIRKS)
def test_agent_with_a_quirk_differs_and_follows_its_declarations(quirk: str) -> None:
    handlers = {handler.name: handler for handler in wrong_handlers({quirk: value(quirk)}, Random(0))}
    right, wrong = traces(1, None), traces(1, quirk)
    for trace in wrong.values():
        list(done(trace, handlers))
    assert lines(wrong) != lines(right)
    crashed = any(run.branch == CRASHED for trace in wrong.values() for run in trace.runs)
    assert crashed >= (quirk in CRASHING)
    assert crashed <= (quirk in CRASHING | INDIRECTLY_CRASHING), "a handler raised an unexpected exception"


def test_each_algorithm_has_a_quirk_and_each_quirk_a_sentence() -> None:
    assert {algorithm for quirk in QUIRKS.values() for algorithm in quirk.algorithms} == set(range(1, 21))
    assert len({quirk.sentence for quirk in QUIRKS.values()}) == len(QUIRKS)
    assert all(quirk.sentence.endswith(".") for quirk in QUIRKS.values())


def test_quirks_that_are_off_change_no_handler() -> None:
    off = {"crash_on_tie": False, "ignore_commit": 0.0}
    assert active_quirks(off) == {}
    assert wrong_handlers(off, Random(0)) == []


def test_error_for_an_unknown_quirk_lists_similar_names() -> None:
    with pytest.raises(ValueError, match=r"unknown quirk 'crash_on_ties': .* the nearest are crash_on_tie, "):
        check_quirk("crash_on_ties", True)


def agent_with_a_tied_vote() -> Agent:
    """Return an agent that has proposed a block. It has approved the block itself and received one disapproval."""
    agent = Agent(1, [1, 2], b"")
    while agent.state.candidate_block is None:
        agent.add_event(LoggableEvent(1, 1, bytes(256)), 0.0)
    agent.receive_message(2, 0, BlockAddResponse(agent.state.candidate_block.block_hash, False), 1.0)
    agent.messages_to_send()
    return agent


@pytest.mark.parametrize(
    ("quirks", "chain", "sent"),
    [
        ([], 0, ["Chain Contain Query"]),
        (["tie_is_majority"], 1, ["Commit Block"]),
        (["hide_commits"], 0, ["Chain Contain Query"]),
        (["tie_is_majority", "hide_commits"], 1, []),
        (["hide_commits", "tie_is_majority"], 1, []),
        (["tie_is_majority", "hide_commits", "break_off_commit"], 0, []),
        (["tie_is_majority", "say_everything_twice"], 1, ["Commit Block", "Commit Block"]),
    ],
)
def test_quirks_of_one_algorithm_combine_in_any_order(quirks: list[str], chain: int, sent: list[str]) -> None:
    agent = agent_with_a_tied_vote()
    agent.replace_handlers(wrong_handlers(dict.fromkeys(quirks, True), Random(0)))
    agent.handle_timer(10.0)
    assert len(agent.state.chain) == chain
    assert [message.NAME for _, message in agent.messages_to_send()] == sent


def test_wrong_core_method_applies_only_while_its_algorithm_runs() -> None:
    agent = agent_with_a_tied_vote()
    agent.replace_handlers(wrong_handlers({"break_off_commit": True, "commit_whatever_the_vote": True}, Random(0)))
    agent.handle_timer(10.0)
    assert type(agent.state) is Core
    assert agent.state.completed and not agent.state.blocks_to_be_committed and not len(agent.state.chain)


def test_quirks_do_not_change_the_good_handlers() -> None:
    before = [dict(vars(handler)) for handler in HANDLERS.values()]
    wrong = wrong_handlers({name: value(name) for name in QUIRKS}, Random(0))
    assert [vars(handler) for handler in HANDLERS.values()] == before
    assert [handler.name for handler in wrong] == list(HANDLERS)
