"""Test Algorithms 1 to 7 of the reference implementation against the thesis, without use of `ucp`."""

import pytest

from tests.harness.checker.reference.driver import (
    OTHER_HASH,
    agent_with_chain,
    block_of,
    complete,
    messages,
    new_agent,
    receive_commit,
    top,
    trace,
    vote,
)
from ucp.block import LATEST_US, Block, next_chain_hash
from ucp.events import LoggableEvent
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    ChainContainQuery,
    ChainHashSuccessorQuery,
    CommitBlock,
    Message,
    RequestForBlock,
)

# Algorithm 1


def test_event_below_the_limit_stays_in_the_current_block() -> None:
    agent = new_agent()
    event = LoggableEvent(5, 9, bytes(1024 - 267 - 11 - 1))
    assert trace(agent.log(event, 0.0)) == [("build_data_block", "building")]
    assert agent.state.current_block == event.encode()
    assert agent.state.completed == []


def test_block_is_full_when_the_largest_event_may_reach_the_limit() -> None:
    agent = new_agent()
    event = LoggableEvent(5, 9, bytes(1024 - 267 - 11))
    steps = agent.log(event, 0.0)
    assert trace(steps) == [("build_data_block", "full"), ("process_next_deque_block", "proposed")]
    block = Block(1, 5, event.encode())
    name = block.block_hash.hex()
    assert list(agent.state.blocks_to_be_committed) == [block]
    assert agent.state.completed == [block.block_hash]
    assert agent.state.current_block == b""
    assert steps[0].changes == [("complete", name), ("deque+", name)]
    assert agent.state.holds(block.block_hash)


def test_block_takes_the_timestamp_of_its_newest_event() -> None:
    agent = new_agent()
    events = [LoggableEvent(timestamp_us, 1, bytes(256)) for timestamp_us in (10, 20, 30)]
    branches = [agent.log(event, 0.0)[0].branch for event in events]
    assert branches == ["building", "building", "full"]
    [block] = agent.state.blocks_to_be_committed
    assert block.timestamp_us == 30
    assert block.event_data == b"".join(event.encode() for event in events)


def test_block_is_a_microsecond_later_than_the_previous_block() -> None:
    agent = new_agent()
    for timestamp_us in (100, 100, 40):
        complete(agent, timestamp_us)
    assert [block.timestamp_us for block in agent.state.blocks_to_be_committed] == [100, 101, 102]


def test_block_timestamp_stays_at_the_latest_timestamp() -> None:
    agent = new_agent()
    complete(agent, LATEST_US)
    agent.log(LoggableEvent(LATEST_US, 2, bytes(800)), 0.0)
    assert [block.timestamp_us for block in agent.state.blocks_to_be_committed] == [LATEST_US, LATEST_US]


def test_first_block_may_have_timestamp_zero() -> None:
    agent = new_agent()
    complete(agent, 0)
    assert agent.state.blocks_to_be_committed[0].timestamp_us == 0


def test_agent_completes_blocks_during_a_reconcile() -> None:
    agent = new_agent()
    agent.begin_reconcile(0.0)
    assert trace(complete(agent)) == [
        ("build_data_block", "full"),
        ("process_next_deque_block", "reconcile in progress"),
    ]


# Algorithm 2


def test_proposal_names_the_front_block_and_the_top() -> None:
    agent = agent_with_chain(1)
    _, step = complete(agent, now=3.0)
    front = agent.state.blocks_to_be_committed[0]
    assert step.sent == [(0, BlockAddRequest(front.block_hash, top(agent)))]
    assert step.started == {"voting": 10.0}
    assert step.tally == {"yes": 1, "no": 0}
    assert agent.state.voting_timer.deadline == 13.0
    assert agent.state.candidate_block == front
    assert agent.state.top_chain_hash_at_initiation == top(agent)


def test_running_vote_prevents_a_second_proposal() -> None:
    agent = new_agent()
    complete(agent)
    steps = complete(agent, 200)
    assert trace(steps)[1:] == [("process_next_deque_block", "vote running")]
    assert messages(steps) == []


def test_empty_deque_ends_the_commit_process() -> None:
    agent = new_agent()
    complete(agent)
    assert trace(agent.expire("voting", 10.0))[1:] == [("process_next_deque_block", "deque empty")]
    assert agent.state.idle


# Algorithm 3


def test_agent_approves_a_proposal_for_its_own_top() -> None:
    agent = agent_with_chain(1)
    [step] = agent.receive(2, BlockAddRequest(OTHER_HASH, top(agent)), 0.0)
    assert step.branch == "approve"
    assert step.sent == [(0, BlockAddResponse(OTHER_HASH, True))]


def test_agent_disapproves_a_proposal_for_another_top() -> None:
    agent = agent_with_chain(1)
    [step] = agent.receive(2, BlockAddRequest(OTHER_HASH, agent.state.chain.inception.chain_hash), 0.0)
    assert step.branch == "disapprove"
    assert step.sent == [(0, BlockAddResponse(OTHER_HASH, False))]


def test_vote_names_the_chain_of_the_proposer_with_the_setting() -> None:
    agent = agent_with_chain(1, vote_names_chain=True)
    steps = agent.receive(2, BlockAddRequest(OTHER_HASH, OTHER_HASH), 0.0)
    assert messages(steps) == [BlockAddResponse(OTHER_HASH, False, OTHER_HASH)]


@pytest.mark.parametrize(
    "message",
    [
        BlockAddRequest(OTHER_HASH, OTHER_HASH),
        CommitBlock(block_of(2, 10), OTHER_HASH),
        ChainContainQuery(OTHER_HASH),
        ChainHashSuccessorQuery(OTHER_HASH),
        RequestForBlock(OTHER_HASH),
    ],
    ids=lambda message: type(message).__name__,
)
def test_reconciling_agent_answers_no_request(message: Message) -> None:
    agent = new_agent()
    agent.begin_reconcile(0.0)
    [step] = agent.receive(2, message, 1.0)
    assert (step.branch, step.sent, step.changes) == ("reconcile in progress", [], [])


# Algorithm 4


def test_vote_without_a_running_vote_is_ignored() -> None:
    agent = new_agent()
    [step] = agent.receive(2, BlockAddResponse(OTHER_HASH, True), 0.0)
    assert step.branch == "no vote running"


def test_vote_on_another_block_is_ignored() -> None:
    agent = new_agent()
    complete(agent)
    [step] = agent.receive(2, BlockAddResponse(OTHER_HASH, False), 0.0)
    assert (step.branch, step.tally) == ("another block", {"yes": 1, "no": 0})


def test_agent_counts_one_vote_per_responder() -> None:
    agent = new_agent()
    complete(agent)
    assert vote(agent, 2, approve=True) == "yes"
    assert vote(agent, 2, approve=True) == "counted already"
    assert vote(agent, 2, approve=False) == "counted already"
    assert vote(agent, 3, approve=False) == "no"
    assert agent.state.vote_count == {"yes": 2, "no": 1}


def test_next_round_counts_the_same_responder_again() -> None:
    agent = new_agent()
    complete(agent)
    vote(agent, 2, approve=True)
    receive_commit(agent, block_of(3, 5))
    agent.expire("voting", 10.0)
    assert vote(agent, 2, approve=True) == "yes"
    assert agent.state.vote_count == {"yes": 2, "no": 0}


def test_vote_of_an_earlier_round_is_ignored_with_the_setting() -> None:
    agent = new_agent(vote_names_chain=True)
    complete(agent)
    assert vote(agent, 2, approve=True, chain_hash=OTHER_HASH) == "another round"
    assert vote(agent, 2, approve=True, chain_hash=top(agent)) == "yes"


def test_named_chain_is_that_of_the_initiation_not_the_top() -> None:
    agent = new_agent(vote_names_chain=True)
    complete(agent)
    initiation = top(agent)
    receive_commit(agent, block_of(3, 5))
    assert vote(agent, 2, approve=True, chain_hash=top(agent)) == "another round"
    assert vote(agent, 2, approve=True, chain_hash=initiation) == "yes"


def test_named_chain_is_ignored_without_the_setting() -> None:
    agent = new_agent()
    complete(agent)
    assert vote(agent, 2, approve=False, chain_hash=OTHER_HASH) == "no"


# Algorithm 5


def test_lone_agent_commits_its_own_block() -> None:
    agent = new_agent()
    complete(agent)
    [block] = agent.state.blocks_to_be_committed
    steps = agent.expire("voting", 10.0)
    assert trace(steps) == [("vote_timer_expiration", "approved"), ("process_next_deque_block", "deque empty")]
    assert list(agent.state.chain) == [block]
    assert steps[0].sent == [(1, CommitBlock(block, top(agent)))]
    assert steps[0].changes == [("deque-", block.block_hash.hex()), ("chain+", block.block_hash.hex())]


def test_commit_proposes_the_next_block_of_the_deque() -> None:
    agent = new_agent()
    complete(agent)
    complete(agent, 200)
    second = agent.state.blocks_to_be_committed[1]
    steps = agent.expire("voting", 10.0)
    assert trace(steps)[1] == ("process_next_deque_block", "proposed")
    assert steps[1].sent == [(2, BlockAddRequest(second.block_hash, top(agent)))]


def test_tied_vote_begins_a_reconcile() -> None:
    agent = new_agent()
    complete(agent)
    vote(agent, 2, approve=False)
    assert trace(agent.expire("voting", 10.0)) == [
        ("vote_timer_expiration", "not approved"),
        ("reconcile_begin", "begun"),
        ("reconcile_phase_1", "asked"),
    ]
    assert len(agent.state.blocks_to_be_committed) == 1
    assert len(agent.state.chain) == 0


def test_changed_chain_repeats_an_approved_vote() -> None:
    agent = new_agent()
    complete(agent)
    receive_commit(agent, block_of(2, 5))
    steps = agent.expire("voting", 10.0)
    assert trace(steps) == [("vote_timer_expiration", "chain changed"), ("process_next_deque_block", "proposed")]
    assert agent.state.top_chain_hash_at_initiation == top(agent)
    assert len(agent.state.chain) == 1


@pytest.mark.parametrize(("changed_first", "branch"), [(False, "not approved"), (True, "chain changed")])
def test_setting_decides_on_a_changed_chain_without_approval(changed_first: bool, branch: str) -> None:
    agent = new_agent(changed_before_tally=changed_first)
    complete(agent)
    vote(agent, 2, approve=False)
    receive_commit(agent, block_of(2, 5))
    assert agent.expire("voting", 10.0)[0].branch == branch


def test_disapproval_begins_a_reconcile_with_changed_before_tally() -> None:
    agent = new_agent(changed_before_tally=True)
    complete(agent)
    vote(agent, 2, approve=False)
    assert agent.expire("voting", 10.0)[0].branch == "not approved"


def test_vote_that_expires_during_a_reconcile_has_no_effect() -> None:
    agent = new_agent()
    complete(agent)
    agent.begin_reconcile(1.0)
    assert agent.state.voting_timer.active
    assert trace(agent.expire("voting", 10.0)) == [("vote_timer_expiration", "reconcile in progress")]
    assert not agent.state.voting_timer.active


def test_approved_commit_starts_the_gap_timer_with_asks_after_commit() -> None:
    agent = new_agent(asks_after_commit=True)
    complete(agent)
    steps = agent.expire("voting", 10.0)
    assert steps[0].started == {"finalize gap": 0.1}
    assert not agent.state.idle


# Algorithm 6


def test_commit_that_does_not_succeed_the_top_is_refused() -> None:
    agent = agent_with_chain(1)
    block = block_of(3, 50)
    message = CommitBlock(block, next_chain_hash(agent.state.chain.inception.chain_hash, block.block_hash))
    [step] = agent.receive(3, message, 0.0)
    assert (step.branch, step.changes) == ("does not succeed", [])


def test_block_that_succeeds_the_top_is_committed() -> None:
    agent = agent_with_chain(1)
    block = block_of(3, 50)
    [step] = receive_commit(agent, block)
    assert (step.branch, step.changes) == ("committed", [("chain+", block.block_hash.hex())])
    assert step.sent == []


def test_block_in_the_chain_is_not_committed_again() -> None:
    agent = agent_with_chain(2)
    assert trace(receive_commit(agent, block_of(2, 10))) == [("receive_commit_block", "held already")]


def test_block_in_the_deque_is_not_committed_by_a_message() -> None:
    agent = new_agent()
    complete(agent)
    [own] = agent.state.blocks_to_be_committed
    assert trace(receive_commit(agent, own)) == [("receive_commit_block", "held already")]
    assert len(agent.state.chain) == 0


# Algorithm 7


def test_reconcile_begins_once() -> None:
    agent = new_agent()
    assert trace(agent.begin_reconcile(0.0)) == [("reconcile_begin", "begun"), ("reconcile_phase_1", "asked")]
    assert trace(agent.begin_reconcile(1.0)) == [("reconcile_begin", "already in progress")]


def test_reconcile_stops_the_gap_timer_with_asks_after_commit() -> None:
    agent = new_agent(asks_after_commit=True)
    complete(agent)
    agent.expire("voting", 10.0)
    agent.begin_reconcile(10.05)
    assert not agent.state.finalize_timer.active
