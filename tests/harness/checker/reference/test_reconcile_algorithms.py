"""Test Algorithms 8 to 20 of the reference implementation against the thesis, without use of `ucp`."""

from typing import Any

import pytest

from harness.checker.reference.state import Settings
from tests.harness.checker.reference.driver import (
    OTHER_HASH,
    Agent,
    Step,
    agent_in_phase_2,
    agent_in_phase_3,
    agent_in_phase_3_with_stack,
    agent_with_chain,
    agent_with_stack,
    answer_phase_1,
    answer_phase_2,
    block_of,
    complete,
    messages,
    new_agent,
    pop_top,
    top,
    trace,
    vote,
)
from ucp.block import next_chain_hash
from ucp.messages import (
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    NextInSequenceResponse,
    RequestForBlock,
)

# Algorithm 8


def test_phase_1_asks_for_the_top_chain_hash() -> None:
    agent = agent_with_chain(1)
    _, step = agent.begin_reconcile(2.0)
    assert step.sent == [(0, ChainContainQuery(top(agent)))]
    assert (step.started, step.tally) == ({"phase one": 5.0}, {"yes": 0, "no": 0})
    assert agent.state.phase_one_timer.deadline == 7.0


# Algorithm 9


def test_agent_confirms_each_chain_hash_it_contains() -> None:
    agent = agent_with_chain(2)
    for chain_hash in (agent.state.chain.inception.chain_hash, top(agent)):
        [step] = agent.receive(2, ChainContainQuery(chain_hash), 0.0)
        assert step.branch == "yes"
        assert messages([step]) == [ChainContainResponse(chain_hash, True)]


def test_agent_denies_an_unknown_chain_hash() -> None:
    [step] = new_agent().receive(2, ChainContainQuery(OTHER_HASH), 0.0)
    assert step.branch == "no"
    assert messages([step]) == [ChainContainResponse(OTHER_HASH, False)]


# Algorithm 10


def test_phase_1_response_outside_phase_1_is_ignored() -> None:
    agent = new_agent()
    [step] = agent.receive(2, ChainContainResponse(top(agent), True), 0.0)
    assert step.branch == "not in phase 1"


def test_phase_1_response_about_another_chain_is_ignored() -> None:
    agent = new_agent()
    agent.begin_reconcile(0.0)
    [step] = agent.receive(2, ChainContainResponse(OTHER_HASH, True), 0.0)
    assert (step.branch, step.tally) == ("another chain", {"yes": 0, "no": 0})


def test_phase_1_counts_one_response_per_responder() -> None:
    agent = new_agent()
    agent.begin_reconcile(0.0)
    assert answer_phase_1(agent, 2, contained=True) == "yes"
    assert answer_phase_1(agent, 2, contained=False) == "counted already"
    assert answer_phase_1(agent, 3, contained=False) == "no"
    assert agent.state.reconcile_vote_count == {"yes": 1, "no": 1}


# Algorithm 11


def test_phase_1_without_response_finalizes() -> None:
    agent = agent_with_chain(1)
    agent.begin_reconcile(0.0)
    assert trace(agent.expire("phase one", 5.0)) == [
        ("reconcile_phase_1_timer_expiration", "no response"),
        ("reconcile_finalize", "done"),
        ("process_next_deque_block", "deque empty"),
    ]
    assert agent.state.idle


def test_majority_of_no_pops_the_top_onto_the_stack() -> None:
    agent = agent_with_chain(2)
    agent.begin_reconcile(0.0)
    steps = pop_top(agent, 5.0)
    name = block_of(2, 20).block_hash.hex()
    assert trace(steps) == [("reconcile_phase_1_timer_expiration", "not contained"), ("reconcile_phase_1", "asked")]
    assert steps[0].changes == [("chain-", name), ("stack+", name)]
    assert agent.state.reconcile_stack == [block_of(2, 20)]
    assert agent.state.holds(block_of(2, 20).block_hash)
    assert messages(steps) == [ChainContainQuery(top(agent))]


def test_majority_of_yes_starts_phase_2() -> None:
    agent = agent_with_chain(1)
    agent.begin_reconcile(0.0)
    answer_phase_1(agent, 2, contained=True)
    assert trace(agent.expire("phase one", 5.0)) == [
        ("reconcile_phase_1_timer_expiration", "contained"),
        ("reconcile_phase_2", "asked"),
    ]


@pytest.mark.parametrize(("setting", "branch"), [("phase2", "contained"), ("pop", "not contained")])
def test_setting_decides_on_a_tie_of_phase_1(setting: str, branch: str) -> None:
    agent = agent_with_chain(1, phase1_tie=setting)
    agent.begin_reconcile(0.0)
    answer_phase_1(agent, 2, contained=True)
    answer_phase_1(agent, 3, contained=False)
    assert agent.expire("phase one", 5.0)[0].branch == branch


def test_inception_block_stays_and_the_agent_finalizes() -> None:
    agent = new_agent()
    agent.begin_reconcile(0.0)
    steps = pop_top(agent, 5.0)
    assert trace(steps)[:2] == [
        ("reconcile_phase_1_timer_expiration", "at inception"),
        ("reconcile_finalize", "done"),
    ]
    assert steps[0].changes == []


# Algorithm 12


def test_phase_2_asks_for_the_successor_of_the_top() -> None:
    agent = agent_with_chain(1)
    agent.begin_reconcile(0.0)
    answer_phase_1(agent, 2, contained=True)
    _, step = agent.expire("phase one", 5.0)
    assert messages([step]) == [ChainHashSuccessorQuery(top(agent))]
    assert (step.started, step.tally) == ({"phase two": 5.0}, {})


def test_phase_2_counts_responders_of_phase_1_again() -> None:
    agent = agent_in_phase_2()
    assert answer_phase_2(agent, 2, OTHER_HASH, 1) == "new candidate"


# Algorithm 13


def test_top_of_chain_carries_the_timestamp_of_the_top_block() -> None:
    agent = agent_with_chain(2)
    [step] = agent.receive(2, ChainHashSuccessorQuery(top(agent)), 0.0)
    assert step.branch == "top of chain"
    assert messages([step]) == [NextInSequenceResponse(top(agent), None, 20)]


def test_top_of_chain_at_inception_has_timestamp_zero() -> None:
    agent = new_agent()
    steps = agent.receive(2, ChainHashSuccessorQuery(top(agent)), 0.0)
    assert messages(steps) == [NextInSequenceResponse(top(agent), None, 0)]


def test_agent_names_the_successor_of_a_chain_hash() -> None:
    agent = agent_with_chain(2)
    inception = agent.state.chain.inception.chain_hash
    [step] = agent.receive(2, ChainHashSuccessorQuery(inception), 0.0)
    assert step.branch == "successor"
    assert messages([step]) == [NextInSequenceResponse(inception, block_of(2, 10).block_hash, 10)]


def test_unknown_chain_hash_begins_a_reconcile() -> None:
    assert trace(new_agent().receive(2, ChainHashSuccessorQuery(OTHER_HASH), 0.0)) == [
        ("receive_request_next_in_sequence", "diverged"),
        ("reconcile_begin", "begun"),
        ("reconcile_phase_1", "asked"),
    ]


def test_vote_continues_when_a_query_begins_a_reconcile() -> None:
    agent = new_agent()
    complete(agent)
    agent.receive(2, ChainHashSuccessorQuery(OTHER_HASH), 1.0)
    assert agent.state.voting_timer.deadline == 10.0
    assert vote(agent, 2, approve=True) == "yes"
    assert trace(agent.expire("phase one", 6.0))[1:] == [
        ("reconcile_finalize", "done"),
        ("process_next_deque_block", "vote running"),
    ]


# Algorithm 14


def test_phase_2_response_outside_phase_2_is_ignored() -> None:
    assert answer_phase_2(new_agent(), 2, OTHER_HASH, 1) == "not in phase 2"


def test_phase_2_response_about_another_chain_is_ignored() -> None:
    [step] = agent_in_phase_2().receive(2, NextInSequenceResponse(OTHER_HASH, OTHER_HASH, 1), 6.0)
    assert (step.branch, step.tally) == ("another chain", {})


def test_phase_2_counts_candidates_and_keeps_the_first_timestamp() -> None:
    agent = agent_in_phase_2()
    assert answer_phase_2(agent, 2, OTHER_HASH, 7) == "new candidate"
    assert answer_phase_2(agent, 2, OTHER_HASH, 7) == "counted already"
    assert answer_phase_2(agent, 3, OTHER_HASH, 5) == "counted"
    assert answer_phase_2(agent, 4, None, 9) == "new candidate"
    assert agent.state.reconcile_response_dictionary == {OTHER_HASH: [2, 7], b"": [1, 9]}


def test_tally_of_phase_2_is_in_hex_and_a_copy() -> None:
    agent = agent_in_phase_2()
    [first] = agent.receive(2, NextInSequenceResponse(top(agent), None, 0), 6.0)
    agent.receive(3, NextInSequenceResponse(top(agent), None, 0), 6.0)
    assert first.tally == {"": [1, 0]}


# Algorithm 15


def choose(answers: list[tuple[bytes | None, int]], **settings: Any) -> Step:
    """Deliver answers of reconcile phase 2 from agents 2, 3, 4 and so on. Return the run of Algorithm 15."""
    agent = agent_in_phase_2(**settings)
    for sender, (block_hash, timestamp_us) in enumerate(answers, 2):
        answer_phase_2(agent, sender, block_hash, timestamp_us)
    return agent.expire("phase two", 10.0)[0]


LOW, HIGH = bytes(32), bytes([255]) * 32


def test_phase_2_without_response_finalizes() -> None:
    agent = agent_in_phase_2()
    assert trace(agent.expire("phase two", 10.0))[:2] == [
        ("reconcile_phase_2_timer_expiration", "no response"),
        ("reconcile_finalize", "done"),
    ]


def test_plurality_wins_phase_2_even_if_it_is_younger() -> None:
    step = choose([(LOW, 1), (HIGH, 9), (HIGH, 9), (None, 0)])
    assert (step.branch, step.tally) == ("block", {HIGH.hex(): 2})


def test_top_of_chain_finalizes() -> None:
    agent = agent_in_phase_2()
    answer_phase_2(agent, 2, None, 0)
    steps = agent.expire("phase two", 10.0)
    assert trace(steps)[:2] == [
        ("reconcile_phase_2_timer_expiration", "top of chain"),
        ("reconcile_finalize", "done"),
    ]
    assert steps[0].tally == {}


def test_oldest_timestamp_wins_a_tie() -> None:
    step = choose([(LOW, 9), (HIGH, 8)])
    assert (step.branch, step.tally) == ("tie: block", {HIGH.hex(): 1})


def test_lowest_hash_wins_a_tie_of_timestamps() -> None:
    step = choose([(HIGH, 8), (LOW, 8)])
    assert (step.branch, step.tally) == ("tie: block", {LOW.hex(): 1})


def test_older_top_of_chain_wins_a_tie() -> None:
    assert choose([(LOW, 9), (None, 8)]).branch == "tie: top of chain"


def test_older_block_wins_a_tie_with_top_of_chain() -> None:
    assert choose([(LOW, 8), (None, 9)]).branch == "tie: block"


def test_top_of_chain_wins_equal_timestamps() -> None:
    assert choose([(LOW, 8), (None, 8)]).branch == "tie: top of chain"


def test_block_wins_a_tie_with_top_of_chain_with_the_setting() -> None:
    step = choose([(None, 0), (HIGH, 9)], phase2_tie="block")
    assert (step.branch, step.tally) == ("tie: block", {HIGH.hex(): 1})


def test_oldest_block_wins_a_tie_of_three_with_the_setting() -> None:
    step = choose([(None, 0), (HIGH, 8), (LOW, 9)], phase2_tie="block")
    assert (step.branch, step.tally) == ("tie: block", {HIGH.hex(): 1})


def test_setting_block_does_not_overrule_a_plurality_of_top() -> None:
    assert choose([(None, 0), (None, 0), (HIGH, 9)], phase2_tie="block").branch == "top of chain"


def test_top_without_majority_is_left_out_with_the_setting() -> None:
    answers = [(None, 0), (None, 0), (LOW, 8), (HIGH, 9), (OTHER_HASH, 9)]
    agent = Agent(1, range(1, 8), b"mission", Settings(top_needs_majority=True))
    agent.begin_reconcile(0.0)
    answer_phase_1(agent, 2, contained=True)
    agent.expire("phase one", 5.0)
    for sender, (block_hash, timestamp_us) in enumerate(answers, 2):
        answer_phase_2(agent, sender, block_hash, timestamp_us)
    step = agent.expire("phase two", 10.0)[0]
    assert (step.branch, step.tally) == ("tie: block", {LOW.hex(): 1})


def test_top_without_majority_makes_no_tie_with_the_setting() -> None:
    step = choose([(None, 0), (LOW, 9), (LOW, 9)], top_needs_majority=True)
    assert (step.branch, step.tally) == ("block", {LOW.hex(): 2})


def test_asking_agent_counts_for_the_top_with_the_setting() -> None:
    assert choose([(None, 0), (LOW, 9)], top_needs_majority=True).branch == "tie: top of chain"
    assert choose([(None, 0)], top_needs_majority=True).branch == "top of chain"
    assert choose([(None, 0), (None, 0), (LOW, 9), (HIGH, 9)], top_needs_majority=True).branch == "top of chain"


# Algorithm 16


def test_phase_3_takes_the_block_from_below_the_stack_top() -> None:
    chosen = block_of(2, 20)
    agent, steps = agent_in_phase_3_with_stack(3, chosen.block_hash)
    name = chosen.block_hash.hex()
    assert trace(steps) == [
        ("reconcile_phase_2_timer_expiration", "block"),
        ("reconcile_phase_3", "from the stack"),
        ("reconcile_phase_2", "asked"),
    ]
    assert steps[1].changes == [("stack-", name), ("chain+", name)]
    assert list(agent.state.chain) == [chosen]
    assert agent.state.reconcile_stack == [block_of(2, 30), block_of(2, 10)]
    assert agent.state.majority_response_block_hash is None
    assert messages(steps) == [ChainHashSuccessorQuery(top(agent))]


def test_phase_3_gives_up_a_block_in_the_deque() -> None:
    agent = new_agent()
    complete(agent)
    [own] = agent.state.blocks_to_be_committed
    agent.begin_reconcile(0.0)
    answer_phase_1(agent, 2, contained=True)
    agent.expire("phase one", 5.0)
    answer_phase_2(agent, 2, own.block_hash, own.timestamp_us)
    assert trace(agent.expire("phase two", 10.0))[1:3] == [
        ("reconcile_phase_3", "held already"),
        ("reconcile_finalize", "done"),
    ]
    assert agent.state.majority_response_block_hash is None
    assert list(agent.state.blocks_to_be_committed) == [own]


def test_phase_3_asks_for_a_block_that_the_agent_lacks() -> None:
    agent, steps = agent_in_phase_3_with_stack(1, OTHER_HASH)
    assert trace(steps)[1:] == [("reconcile_phase_3", "asked")]
    assert messages(steps) == [RequestForBlock(OTHER_HASH)]
    assert steps[1].started == {"phase three": 5.0}
    assert agent.state.majority_response_block_hash == OTHER_HASH


# Algorithm 17


def test_agent_sends_a_block_of_its_chain() -> None:
    agent = agent_with_chain(2)
    [step] = agent.receive(3, RequestForBlock(block_of(2, 10).block_hash), 0.0)
    assert step.branch == "sent"
    assert messages([step]) == [BlockResponse(block_of(2, 10))]


def test_agent_sends_no_block_of_its_deque() -> None:
    agent = new_agent()
    complete(agent)
    own = agent.state.blocks_to_be_committed[0].block_hash
    for block_hash in (own, agent.state.chain.inception.block_hash):
        [step] = agent.receive(3, RequestForBlock(block_hash), 0.0)
        assert (step.branch, step.sent) == ("not held", [])


# Algorithm 18


def test_block_response_outside_phase_3_is_ignored() -> None:
    [step] = agent_in_phase_2().receive(2, BlockResponse(block_of(2, 10)), 6.0)
    assert (step.branch, step.changes) == ("not in phase 3", [])


def test_block_that_was_not_chosen_leaves_the_timer_unchanged() -> None:
    agent = agent_in_phase_3(block_of(2, 10))
    [step] = agent.receive(2, BlockResponse(block_of(2, 11)), 11.3)
    assert (step.branch, step.changes) == ("another block", [])
    assert agent.state.phase_three_timer.deadline == 15.0


def test_chosen_block_is_committed_and_phase_2_follows() -> None:
    block = block_of(2, 10)
    agent = agent_in_phase_3(block)
    steps = agent.receive(2, BlockResponse(block), 11.0)
    assert trace(steps) == [("receive_response_block_for_hash", "committed"), ("reconcile_phase_2", "asked")]
    assert list(agent.state.chain) == [block]
    assert top(agent) == next_chain_hash(agent.state.chain.inception.chain_hash, block.block_hash)
    assert not agent.state.phase_three_timer.active
    assert agent.state.majority_response_block_hash is None
    assert trace(agent.receive(3, BlockResponse(block), 11.1)) == [
        ("receive_response_block_for_hash", "not in phase 3"),
    ]


# Algorithm 19


def test_phase_3_without_the_block_finalizes() -> None:
    agent = agent_in_phase_3(block_of(2, 10))
    assert trace(agent.expire("phase three", 15.0))[:2] == [
        ("reconcile_phase_3_timer_expiration", "gave up"),
        ("reconcile_finalize", "done"),
    ]
    assert agent.state.majority_response_block_hash is None


def test_rebuilt_blocks_stay_below_the_rest_of_the_stack() -> None:
    agent, _ = agent_in_phase_3_with_stack(2, OTHER_HASH, finalize_gap_s=0.0)
    new = block_of(3, 5)
    agent.expire("phase three", 15.0)
    assert list(agent.state.chain) == [block_of(2, 10), block_of(2, 20)]
    agent, _ = agent_in_phase_3_with_stack(2, new.block_hash, finalize_gap_s=0.0)
    agent.receive(2, BlockResponse(new), 11.0)
    answer_phase_2(agent, 2, OTHER_HASH, 5)
    agent.expire("phase two", 16.0)
    agent.expire("phase three", 21.0)
    assert list(agent.state.chain) == [new, block_of(2, 10), block_of(2, 20)]


# Algorithm 20


def test_finalize_pauses_between_two_commits() -> None:
    agent = agent_with_stack(1, 2)
    steps = agent.expire("phase one", 5.0)
    first, second = block_of(2, 20), block_of(2, 30)
    assert trace(steps)[1:] == [("reconcile_finalize", "recommitted, more to come")]
    name = first.block_hash.hex()
    assert steps[1].changes == [("stack-", name), ("chain+", name)]
    assert steps[1].started == {"finalize gap": 0.1}
    assert messages(steps) == [CommitBlock(first, top(agent))]
    assert agent.state.reconcile_in_progress
    steps = agent.expire("finalize gap", 5.1)
    assert trace(steps) == [("reconcile_finalize", "done"), ("process_next_deque_block", "deque empty")]
    assert messages(steps) == [CommitBlock(second, top(agent))]
    assert steps[0].started == {}
    assert agent.state.idle


def test_finalize_without_gap_commits_all_blocks_in_one_run() -> None:
    agent = agent_with_stack(0, 3, finalize_gap_s=0.0)
    steps = agent.expire("phase one", 5.0)
    assert trace(steps)[1:] == [("reconcile_finalize", "done"), ("process_next_deque_block", "deque empty")]
    assert [step.timestamp_us for step in agent.state.chain] == [10, 20, 30]
    assert [type(message) for message in messages(steps)] == [CommitBlock] * 3


def test_finalize_proposes_blocks_completed_during_the_reconcile() -> None:
    agent = new_agent()
    agent.begin_reconcile(0.0)
    complete(agent)
    assert trace(agent.expire("phase one", 5.0))[1:] == [
        ("reconcile_finalize", "done"),
        ("process_next_deque_block", "proposed"),
    ]


def test_agent_asks_for_followers_after_its_commit_with_the_setting() -> None:
    agent = new_agent(asks_after_commit=True)
    complete(agent)
    agent.expire("voting", 10.0)
    [step] = agent.expire("finalize gap", 10.1)
    assert (step.branch, step.changes, step.started) == ("asked who follows", [], {})
    assert messages([step]) == [ChainHashSuccessorQuery(top(agent))]
    assert agent.state.idle


def test_reconcile_finalizes_as_usual_with_asks_after_commit() -> None:
    agent = agent_with_stack(0, 1, asks_after_commit=True)
    assert trace(agent.expire("phase one", 5.0))[1] == ("reconcile_finalize", "done")
