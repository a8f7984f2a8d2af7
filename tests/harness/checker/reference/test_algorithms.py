"""Test the reference implementation against Chapter 3 of the thesis case by case, without use of `ucp`.

The agent under test has ID 1. Agents 2 to 5 exist only as senders of messages. The tests follow the order of the
algorithms.
"""

import random
from hashlib import sha256
from typing import Any

import pytest

from harness.checker.reference.algorithms import HANDLERS, ON_LOCAL_EVENT, ON_MESSAGE, ON_TIMER
from harness.checker.reference.state import Chain, ReferenceState, Settings, Timer
from tests.harness.checker.reference.driver import Agent, Step
from ucp.block import LATEST_US, Block, InceptionBlock, next_chain_hash
from ucp.events import LoggableEvent
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
)

ROSTER = range(1, 6)
OTHER_HASH = bytes(31) + b"\1"
Trace = list[tuple[str, str]]


def new_agent(agent_id: int = 1, **settings: Any) -> Agent:
    return Agent(agent_id, ROSTER, b"mission", Settings(**settings))


def block_of(agent_id: int, timestamp_us: int) -> Block:
    return Block(agent_id, timestamp_us, b"x")


def trace(steps: list[Step]) -> Trace:
    return [(step.handler.name, step.branch) for step in steps]


def messages(steps: list[Step]) -> list[Message]:
    return [message for step in steps for _, message in step.sent]


def top(agent: Agent) -> bytes:
    return agent.state.chain.top_chain_hash


def complete(agent: Agent, timestamp_us: int = 100, now: float = 0.0) -> list[Step]:
    """Log one event that completes a block, and return the resulting steps."""
    return agent.log(LoggableEvent(timestamp_us, 1, bytes(800)), now)


def receive_commit(agent: Agent, block: Block, now: float = 0.0) -> list[Step]:
    """Deliver a Commit Block message whose block follows the agent's top block."""
    return agent.receive(2, CommitBlock(block, next_chain_hash(top(agent), block.block_hash)), now)


def agent_with_chain(count: int, **settings: Any) -> Agent:
    """Return an agent whose chain holds blocks of agent 2 with the timestamps 10, 20, 30 and so on."""
    agent = new_agent(**settings)
    for number in range(1, count + 1):
        assert trace(receive_commit(agent, block_of(2, 10 * number))) == [("receive_commit_block", "committed")]
    return agent


def vote(agent: Agent, sender: int, *, approve: bool, chain_hash: bytes | None = None) -> str:
    candidate = agent.state.candidate_block
    assert candidate is not None
    [step] = agent.receive(sender, BlockAddResponse(candidate.block_hash, approve, chain_hash), 1.0)
    return step.branch


def answer_phase_1(agent: Agent, sender: int, *, contained: bool) -> str:
    [step] = agent.receive(sender, ChainContainResponse(top(agent), contained), 1.0)
    return step.branch


def answer_phase_2(agent: Agent, sender: int, block_hash: bytes | None, timestamp_us: int) -> str:
    [step] = agent.receive(sender, NextInSequenceResponse(top(agent), block_hash, timestamp_us), 6.0)
    return step.branch


def agent_in_phase_2(count: int = 0, **settings: Any) -> Agent:
    agent = agent_with_chain(count, **settings)
    agent.begin_reconcile(0.0)
    answer_phase_1(agent, 2, contained=True)
    agent.expire("phase one", 5.0)
    return agent


def agent_in_phase_3(block: Block, **settings: Any) -> Agent:
    agent = agent_in_phase_2(**settings)
    answer_phase_2(agent, 2, block.block_hash, block.timestamp_us)
    agent.expire("phase two", 10.0)
    return agent


def pop_top(agent: Agent, now: float = 0.0) -> list[Step]:
    """Run one round of reconcile phase 1 in which the only answer is "no"."""
    answer_phase_1(agent, 2, contained=False)
    return agent.expire("phase one", now)


def agent_with_stack(chain_count: int, stack_count: int, **settings: Any) -> Agent:
    """Return an agent in reconcile phase 1 that has removed `stack_count` blocks from its chain."""
    agent = agent_with_chain(chain_count + stack_count, **settings)
    agent.begin_reconcile(0.0)
    for _ in range(stack_count):
        pop_top(agent)
    return agent


def agent_in_phase_3_with_stack(stack_count: int, chosen: bytes, **settings: Any) -> tuple[Agent, list[Step]]:
    """Return an agent whose reconcile phase 2 chose `chosen` after it removed its whole chain, and the steps."""
    agent = agent_with_stack(0, stack_count, **settings)
    answer_phase_1(agent, 2, contained=True)
    agent.expire("phase one", 5.0)
    answer_phase_2(agent, 2, chosen, 10)
    return agent, agent.expire("phase two", 10.0)


# Timer, chain, state


def test_resumed_timer_moves_its_deadline_by_the_pause() -> None:
    timer = Timer("voting")
    timer.start(1.0, 10.0)
    timer.pause(2.0)
    assert timer.active
    timer.resume(5.0)
    assert timer.deadline == 14.0
    timer.pause(6.0)
    timer.resume(6.0)
    assert timer.deadline == 14.0


def test_stopped_timer_is_inactive_and_ignores_pause_and_resume() -> None:
    timer = Timer("voting")
    timer.start(0.0, 10.0)
    timer.pause(1.0)
    timer.stop()
    timer.pause(2.0)
    timer.resume(3.0)
    assert not timer.active
    assert timer.deadline is None
    timer.start(0.0, 1.0)
    timer.resume(9.0)
    assert timer.deadline == 1.0


def test_chain_hashes_follow_equations_3_1_to_3_5() -> None:
    chain = Chain(InceptionBlock(b"mission"))
    inception_chain_hash = sha256(sha256(b"mission").digest()).digest()
    assert chain.top_chain_hash == inception_chain_hash
    block = Block(7, 258, b"ev")
    block_hash = sha256(bytes((0, 0, 0, 7)) + bytes((0, 0, 0, 0, 0, 0, 1, 2)) + b"ev").digest()
    assert block.block_hash == block_hash
    chain.append(block)
    assert chain.top_chain_hash == sha256(inception_chain_hash + block_hash).digest()


def test_chain_answers_by_block_hash_and_chain_hash() -> None:
    chain = Chain(InceptionBlock(b"mission"))
    hashes = [chain.top_chain_hash]
    assert (len(chain), list(chain), chain.top_timestamp_us) == (0, [], 0)
    blocks = [block_of(2, 10), block_of(3, 20)]
    for block in blocks:
        chain.append(block)
        hashes.append(chain.top_chain_hash)
    assert (len(chain), list(chain), chain.top_timestamp_us) == (2, blocks, 20)
    assert [chain.successor(chain_hash) for chain_hash in hashes] == [*blocks, None]
    assert all(chain.contains_chain_hash(chain_hash) for chain_hash in hashes)
    assert chain.get(blocks[0].block_hash) == blocks[0]
    assert chain.get(OTHER_HASH) is None
    assert blocks[1].block_hash in chain
    assert not chain.contains_chain_hash(OTHER_HASH)
    assert chain.pop() == blocks[1]
    assert chain.top_chain_hash == hashes[1]
    assert chain.successor(hashes[1]) is None
    assert not chain.contains_chain_hash(hashes[2])
    assert blocks[1].block_hash not in chain


def test_chain_rejects_a_second_copy_of_a_block() -> None:
    chain = Chain(InceptionBlock(b"mission"))
    chain.append(block_of(2, 10))
    before = chain.top_chain_hash
    with pytest.raises(ValueError, match="already"):
        chain.append(block_of(2, 10))
    assert (len(chain), chain.top_chain_hash) == (1, before)


def test_chain_never_pops_the_inception_block() -> None:
    with pytest.raises(IndexError):
        Chain(InceptionBlock(b"mission")).pop()


def test_new_state_is_idle_and_holds_nothing() -> None:
    state = ReferenceState(1, b"mission", Settings())
    assert state.idle
    assert not state.holds(OTHER_HASH)
    assert [timer.name for timer in state.timers] == ["voting", "phase one", "phase two", "phase three", "finalize gap"]
    assert state.reconcile_timers == state.timers[1:]


def test_state_holds_a_block_until_the_block_leaves() -> None:
    state = ReferenceState(1, b"mission", Settings())
    first, second, third = (block_of(2, timestamp_us) for timestamp_us in (1, 2, 3))
    state.push_deque(first)
    state.push_stack(second)
    state.commit(third)
    assert all(state.holds(block.block_hash) for block in (first, second, third))
    state.pop_deque()
    state.pop_stack()
    state.chain.pop()
    assert not any(state.holds(block.block_hash) for block in (first, second, third))


def test_partly_filled_current_block_leaves_the_agent_idle() -> None:
    agent = new_agent()
    agent.log(LoggableEvent(1, 1, b"abc"), 0.0)
    assert agent.state.idle


def test_armed_timer_makes_the_agent_busy() -> None:
    agent = new_agent()
    complete(agent)
    assert not agent.state.idle


def test_tables_name_twenty_handlers_in_order() -> None:
    assert [handler.algorithm for handler in HANDLERS.values()] == list(range(1, 21))
    assert all(name == handler.name for name, handler in HANDLERS.items())
    handlers = [*ON_MESSAGE.values(), *ON_TIMER.values(), *ON_LOCAL_EVENT.values()]
    assert {id(handler) for handler in handlers} == {id(handler) for handler in HANDLERS.values()}
    assert ON_TIMER["finalize gap"] is ON_LOCAL_EVENT["Reconcile Finalize"]


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


def test_vote_runs_on_when_a_query_begins_a_reconcile() -> None:
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
    """Answer reconcile phase 2 as agents 2, 3, 4 and so on. Return the step of Algorithm 15."""
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


# Driver


@pytest.mark.parametrize(
    ("sender", "message"),
    [
        (1, ChainContainQuery(OTHER_HASH)),
        (9, ChainContainQuery(OTHER_HASH)),
        (2, CommitBlock(block_of(9, 10), OTHER_HASH)),
        (2, BlockResponse(block_of(9, 10))),
    ],
    ids=["own message", "foreign sender", "foreign block to commit", "foreign block in a response"],
)
def test_agent_ignores_input_from_outside_the_mission(sender: int, message: Message) -> None:
    assert new_agent().receive(sender, message, 0.0) == []


def test_stopped_timer_does_not_expire() -> None:
    assert new_agent().expire("voting", 10.0) == []


def test_sequence_numbers_count_all_messages_of_an_agent() -> None:
    agent = new_agent()
    complete(agent)
    steps = agent.expire("voting", 10.0) + agent.begin_reconcile(11.0)
    assert [sequence for step in steps for sequence, _ in step.sent] == [1, 2]
    assert agent.state.sequence == 3


def test_local_event_names_the_handler_that_triggered_it() -> None:
    state = new_agent().state
    state.running = HANDLERS["build_data_block"]
    HANDLERS["build_data_block"].run(state, LoggableEvent(1, 1, bytes(800)))
    assert list(state.triggered) == [("Process Next Deque Block", "build_data_block")]
    assert not state.idle


def test_boot_restores_the_blocks_and_finalizes_a_reconcile() -> None:
    in_chain, in_deque, on_stack = block_of(1, 10), block_of(1, 30), block_of(2, 90)
    lost = block_of(1, 50)
    agent = new_agent(vote_timeout_s=4.0)
    completed = [in_chain.block_hash, in_deque.block_hash, lost.block_hash]
    steps = agent.boot(completed, [in_chain], [in_deque], [on_stack], 7.0)
    assert trace(steps) == [("reconcile_finalize", "done"), ("process_next_deque_block", "proposed")]
    assert steps[0].changes == [
        *(("complete", block_hash.hex()) for block_hash in completed),
        ("chain+", in_chain.block_hash.hex()),
        ("deque+", in_deque.block_hash.hex()),
        ("stack+", on_stack.block_hash.hex()),
        ("stack-", on_stack.block_hash.hex()),
        ("chain+", on_stack.block_hash.hex()),
    ]
    assert list(agent.state.chain) == [in_chain, on_stack]
    assert agent.state.completed == completed
    assert agent.state.newest_block_timestamp_us == 30
    assert agent.state.voting_timer.deadline == 11.0
    assert not agent.state.reconcile_in_progress


def test_restored_agent_is_in_a_reconcile() -> None:
    state = ReferenceState(1, b"mission", Settings())
    state.restore([], [], [], [])
    assert state.reconcile_in_progress
    assert state.newest_block_timestamp_us == -1


# Whole swarms


def run_swarm(seed: int, loss: float, **settings: Any) -> list[Agent]:
    """Run five agents until all are idle, with delays of 2-50 ms, and check invariants after each input."""
    rng = random.Random(seed)
    agents = {agent_id: new_agent(agent_id, **settings) for agent_id in ROSTER}
    inputs: list[tuple[float, int, int, int, Message | LoggableEvent]] = []
    for order in range(60):
        now = rng.uniform(0, 400)
        inputs.append((now, -order, rng.choice(ROSTER), 0, LoggableEvent(int(now * 1e6), 1, bytes(256))))
    serial = 0
    for _ in range(100_000):
        timers = [
            (timer.deadline, agent_id, timer)
            for agent_id, agent in agents.items()
            for timer in agent.state.timers
            if timer.deadline is not None
        ]
        next_timer = min(timers, key=lambda each: each[:2], default=None)
        next_input = min(inputs, key=lambda each: each[:2], default=None)
        if next_input is not None and (next_timer is None or next_input[0] <= next_timer[0]):
            inputs.remove(next_input)
            now, _, receiver, sender, content = next_input
            agent = agents[receiver]
            if isinstance(content, LoggableEvent):
                steps = agent.log(content, now)
            else:
                steps = agent.receive(sender, content, now)
        elif next_timer is not None:
            now, receiver, timer = next_timer
            agent = agents[receiver]
            steps = agent.expire(timer, now)
        else:
            return list(agents.values())
        for message in messages(steps):
            for other in agents:
                if other != receiver and rng.random() >= loss:
                    serial += 1
                    inputs.append((now + rng.uniform(0.002, 0.05), serial, other, receiver, message))
        check_invariants(agent)
    raise AssertionError("the swarm did not become idle")


def check_invariants(agent: Agent) -> None:
    state = agent.state
    held = [block.block_hash for block in (*state.chain, *state.blocks_to_be_committed, *state.reconcile_stack)]
    assert len(held) == len(set(held))  # characteristic 3
    assert set(state.completed) <= set(held)
    assert all(state.holds(block_hash) for block_hash in held)
    if state.idle:
        assert not state.blocks_to_be_committed  # characteristic 2
        assert not state.reconcile_stack
    chain_hash = state.chain.inception.chain_hash
    for block in state.chain:
        chain_hash = sha256(chain_hash + block.block_hash).digest()
    assert chain_hash == state.chain.top_chain_hash


@pytest.mark.parametrize("seed", range(5))
def test_swarm_keeps_characteristics_2_and_3_at_any_loss(seed: int) -> None:
    run_swarm(seed, loss=(0.0, 0.15, 0.3, 0.5, 0.75)[seed])


def test_swarm_with_every_setting_changed_becomes_idle() -> None:
    settings: dict[str, Any] = {
        "vote_names_chain": True,
        "changed_before_tally": True,
        "phase1_tie": "pop",
        "phase2_tie": "block",
        "asks_after_commit": True,
        "top_needs_majority": True,
    }
    run_swarm(8, loss=0.2, **settings)


def test_agents_cut_off_from_each_other_commit_only_their_own_blocks() -> None:
    for agent in run_swarm(3, loss=1.0):
        assert [block.block_hash for block in agent.state.chain] == agent.state.completed
        assert not agent.state.reconcile_in_progress


def test_swarm_without_loss_holds_all_blocks_in_every_chain() -> None:
    agents = run_swarm(1, loss=0.0)
    completed = {block_hash for agent in agents for block_hash in agent.state.completed}
    assert completed
    assert len({top(agent) for agent in agents}) == 1
    assert all({block.block_hash for block in agent.state.chain} == completed for agent in agents)
