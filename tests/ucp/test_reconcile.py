"""Test Algorithms 7 to 20, handler by handler, with divergences and ties that the thesis could not force."""

from itertools import accumulate, pairwise
from random import Random

import pytest

from tests.ucp.air import Air, uniform_latency
from tests.ucp.branches import takes
from ucp.agent import Agent
from ucp.block import Block, next_chain_hash
from ucp.messages import (
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
)
from ucp.quirks import wrong_handlers
from ucp.settings import Settings


def part(*groups: set[int]):
    """Return a network in which each agent receives only messages of its own group."""
    latency = uniform_latency(Random(2))
    return lambda sender, receiver, message: (
        latency(sender, receiver, message) if any({sender, receiver} <= group for group in groups) else []
    )


def diverged(blocks_on_2: int = 1, **settings: object) -> Air:
    """Return three agents. Agents 2 and 3 have the same chain. Agent 1 has a different chain of one block."""
    air = Air([1, 2, 3], fate=part({1}, {2, 3}), settings=Settings(**settings))
    air.fill_block(1)
    for _ in range(blocks_on_2):
        air.fill_block(2)
        air.settle()
    air.fate = uniform_latency(Random(3))
    return air


def with_blocks(count: int) -> Agent:
    """Return an agent with `count` blocks in its chain."""
    air = Air([1, 2], fate=lambda *_: [])
    for _ in range(count):
        air.fill_block(1)
        air.settle()
    return air.agents[1]


def answers(agent: Agent, message: Message) -> list[Message]:
    agent.receive_message(2, 0, message, agent.state.now)
    return [answer for _, answer in agent.messages_to_send()]


A, B = b"\xaa" * 32, b"\xbb" * 32


@takes("reconcile_begin", "begun")
@takes("reconcile_phase_1", "asked")
@takes("reconcile_phase_2", "asked")
@takes("reconcile_phase_3", "asked")
def test_each_phase_asks_its_question_and_waits_for_answers() -> None:
    agent = Air([1, 2]).agents[1]
    top = agent.state.chain.top_chain_hash
    agent.begin_reconcile(0.0)
    assert agent.messages_to_send() == [(0, ChainContainQuery(top))]
    assert agent.next_timer() == 5.0
    agent.receive_message(2, 0, ChainContainResponse(top, True), 1.0)
    agent.handle_timer(5.0)
    assert agent.messages_to_send() == [(1, ChainHashSuccessorQuery(top))]
    assert agent.next_timer() == 10.0
    agent.receive_message(2, 1, NextInSequenceResponse(top, A, 5), 6.0)
    agent.handle_timer(10.0)
    assert agent.messages_to_send() == [(2, RequestForBlock(A))]
    assert agent.next_timer() == 15.0


@takes("receive_request_chain_contain", "yes", "no")
def test_agent_answers_whether_its_chain_contains_a_chain_hash() -> None:
    agent = with_blocks(2)
    (_, below), (_, top) = agent.state.chain.with_chain_hashes()
    for chain_hash, contained in ((below, True), (top, True), (bytes(32), False)):
        assert answers(agent, ChainContainQuery(chain_hash)) == [ChainContainResponse(chain_hash, contained)]


@takes("receive_request_next_in_sequence", "successor", "top of chain")
def test_agent_answers_with_its_next_block_or_the_top_of_its_chain() -> None:
    agent = with_blocks(2)
    (_, below), (block, top) = agent.state.chain.with_chain_hashes()
    successor = NextInSequenceResponse(below, block.block_hash, block.timestamp_us)
    assert answers(agent, ChainHashSuccessorQuery(below)) == [successor]
    assert answers(agent, ChainHashSuccessorQuery(top)) == [NextInSequenceResponse(top, None, block.timestamp_us)]


@takes("receive_request_block_for_hash", "sent", "not held")
def test_agent_sends_only_requested_blocks_of_its_chain() -> None:
    agent = with_blocks(1)
    (block,) = agent.state.chain
    assert answers(agent, RequestForBlock(block.block_hash)) == [BlockResponse(block)]
    assert answers(agent, RequestForBlock(bytes(32))) == []


@takes("receive_phase_1_response", "not in phase 1")
@takes("receive_response_next_in_sequence", "not in phase 2")
@takes("receive_response_block_for_hash", "not in phase 3")
def test_unexpected_answer_changes_nothing() -> None:
    agent = with_blocks(1)
    top = agent.state.chain.top_chain_hash
    late = Block(2, 1, b"late")
    assert answers(agent, ChainContainResponse(top, False)) == []
    assert answers(agent, NextInSequenceResponse(top, late.block_hash, 1)) == []
    assert answers(agent, BlockResponse(late)) == []
    assert agent.state.reconcile_vote_count == {"yes": 0, "no": 0}
    assert not agent.state.reconcile_response_dictionary
    assert agent.state.chain.top_chain_hash == top
    assert agent.state.idle


@takes("reconcile_phase_1_timer_expiration", "not contained", "contained")
@takes("reconcile_phase_2_timer_expiration", "block", "top of chain")
@takes("receive_response_block_for_hash", "committed")
@takes("reconcile_finalize", "done")
def test_outvoted_agent_rebuilds_on_the_chain_of_the_majority() -> None:
    air = diverged(blocks_on_2=2)
    (own,) = air.agents[1].state.completed
    theirs = tuple(air.agents[2].state.completed)
    air.reconcile(1)
    assert air.chains() == [(*theirs, own)] * 3
    assert air.branches(1, "reconcile_phase_1_timer_expiration") == ["not contained", "contained"]
    assert air.branches(1, "reconcile_phase_2_timer_expiration") == ["block", "block", "top of chain"]
    assert air.branches(1, "reconcile_phase_3") == ["asked", "asked"]
    assert air.branches(1, "receive_response_block_for_hash")[0] == "committed"


def test_vote_against_a_diverged_chain_starts_the_reconcile() -> None:
    air = diverged()
    air.fill_block(1)
    air.settle()
    assert air.branches(1, "reconcile_begin") == ["begun"]
    assert len(set(air.chains())) == 1
    assert len(air.agents[1].state.chain) == 3


@takes("reconcile_phase_3", "from the stack")
def test_block_on_the_stack_is_committed_without_a_request() -> None:
    """Agents 2 and 3 have agent 1's first block on top of their chains. Phase 3 of agent 1 finds the block on its
    stack.
    """
    air = diverged()
    own = next(iter(air.agents[1].state.chain))
    for agent in (air.agents[2], air.agents[3]):
        on_top = next_chain_hash(agent.state.chain.top_chain_hash, own.block_hash)
        agent.receive_message(1, 99, CommitBlock(own, on_top), air.now)
    air.reconcile(1)
    assert air.branches(1, "reconcile_phase_3") == ["asked", "from the stack"]
    assert len(set(air.chains())) == 1


@takes("receive_request_next_in_sequence", "diverged")
def test_queried_agent_without_the_chain_starts_a_reconcile() -> None:
    """Agent 3 missed a block. It notices this when it receives the phase 2 query of agent 1 (Algorithm 13)."""
    air = Air([1, 2, 3], fate=part({1, 2}, {3}))
    air.fill_block(1)
    air.settle()
    air.fate = uniform_latency(Random(3))
    air.reconcile(1)
    assert "diverged" in air.branches(3, "receive_request_next_in_sequence")
    assert len(set(air.chains())) == 1


@takes("reconcile_phase_1_timer_expiration", "no response")
def test_reconcile_ends_without_answers_in_phase_1() -> None:
    air = Air([1, 2], fate=lambda *_: [])
    air.reconcile(1)
    assert air.now == 5.0
    assert air.branches(1, "reconcile_phase_1_timer_expiration") == ["no response"]
    assert air.agents[1].state.idle


@takes("reconcile_phase_2_timer_expiration", "no response")
def test_reconcile_ends_without_answers_in_phase_2() -> None:
    air = diverged()
    latency = air.fate
    air.fate = lambda s, r, m: [] if isinstance(m, NextInSequenceResponse) else latency(s, r, m)
    air.reconcile(1)
    assert air.branches(1, "reconcile_phase_2_timer_expiration") == ["no response"]
    assert len(air.agents[1].state.chain) == 1  # its own block is on top of the chain again


@takes("reconcile_phase_3_timer_expiration", "gave up")
def test_missing_block_in_phase_3_returns_the_rest_of_the_stack() -> None:
    air = diverged()
    latency = air.fate
    air.fate = lambda s, r, m: [] if isinstance(m, BlockResponse) else latency(s, r, m)
    air.reconcile(1)
    assert air.branches(1, "reconcile_phase_3_timer_expiration") == ["gave up"]
    assert len(air.agents[1].state.chain) == 1
    assert air.agents[1].state.majority_response_block_hash is None


@takes("reconcile_phase_1_timer_expiration", "at inception")
def test_inception_block_is_never_popped() -> None:
    air = Air([1, 2], fate=lambda *_: [])
    agent = air.agents[1]
    agent.begin_reconcile(0.0)
    agent.receive_message(2, 0, ChainContainResponse(agent.state.chain.top_chain_hash, False), 1.0)
    air.flush(1)
    air.settle()
    assert air.branches(1, "reconcile_phase_1_timer_expiration") == ["at inception"]
    assert agent.state.idle


@takes("receive_phase_1_response", "yes", "no", "counted already", "another chain")
@pytest.mark.parametrize(
    ("phase1_tie", "expected"),
    [
        pytest.param("phase2", "contained", marks=takes("reconcile_phase_1_timer_expiration", "contained")),
        pytest.param("pop", "not contained", marks=takes("reconcile_phase_1_timer_expiration", "not contained")),
    ],
)
def test_tie_in_phase_1_continues_with_phase_2_or_pops(phase1_tie: str, expected: str) -> None:
    air = Air([1, 2, 3], fate=lambda *_: [], settings=Settings(phase1_tie=phase1_tie))
    air.fill_block(1)
    air.settle()
    agent = air.agents[1]
    agent.begin_reconcile(air.now)
    agent.receive_message(2, 0, ChainContainResponse(agent.state.chain.top_chain_hash, True), air.now)
    agent.receive_message(3, 0, ChainContainResponse(agent.state.chain.top_chain_hash, False), air.now)
    agent.receive_message(3, 1, ChainContainResponse(agent.state.chain.top_chain_hash, False), air.now)
    agent.receive_message(3, 1, ChainContainResponse(bytes(32), False), air.now)
    air.run_until(air.now + 5)
    assert air.branches(1, "reconcile_phase_1_timer_expiration") == [expected]
    assert air.branches(1, "receive_phase_1_response") == ["yes", "no", "counted already", "another chain"]


def in_phase_2(agents: int, **settings: object) -> Air:
    """Return agents that cannot reach each other. At 5 s, agent 1 has asked for the block after the inception block."""
    air = Air(range(1, agents + 1), fate=lambda *_: [], settings=Settings(**settings))
    agent = air.agents[1]
    agent.begin_reconcile(0.0)
    agent.receive_message(2, 0, ChainContainResponse(agent.state.chain.top_chain_hash, True), 1.0)
    air.run_until(5.0)
    return air


def phase_2(answers: list[tuple[bytes | None, int]], **settings: object) -> tuple[Air, str]:
    """Give agent 1 these answers of phase 2 from the agents 2, 3 and so on. Return the swarm, and the branch that ends
    phase 2.

    An answer is a block hash and a timestamp.
    """
    air = in_phase_2(len(answers) + 1, **settings)
    agent = air.agents[1]
    for sender, (block_hash, timestamp_us) in enumerate(answers, start=2):
        response = NextInSequenceResponse(agent.state.chain.top_chain_hash, block_hash, timestamp_us)
        agent.receive_message(sender, 1, response, 6.0)
    air.run_until(10.0)
    (branch,) = air.branches(1, "reconcile_phase_2_timer_expiration")
    return air, branch


@takes("receive_response_next_in_sequence", "new candidate", "counted")
@takes("reconcile_phase_2_timer_expiration", "block")
def test_phase_2_follows_the_plurality() -> None:
    air, branch = phase_2([(A, 9), (A, 9), (B, 1), (None, 0)])
    assert branch == "block"
    assert air.agents[1].state.majority_response_block_hash == A
    assert air.branches(1, "receive_response_next_in_sequence") == [
        "new candidate",
        "counted",
        "new candidate",
        "new candidate",
    ]


@takes("reconcile_phase_2_timer_expiration", "tie: block")
def test_tie_in_phase_2_goes_to_the_oldest_block() -> None:
    air, branch = phase_2([(A, 9), (B, 1)])
    assert branch == "tie: block"
    assert air.agents[1].state.majority_response_block_hash == B


@takes("reconcile_phase_2_timer_expiration", "tie: block")
def test_tie_of_equal_timestamps_goes_to_the_lowest_hash() -> None:
    air, _ = phase_2([(B, 5), (A, 5)])
    assert air.agents[1].state.majority_response_block_hash == A


@takes("reconcile_phase_2_timer_expiration", "tie: top of chain")
def test_tie_with_top_of_chain_ends_the_search() -> None:
    air, branch = phase_2([(A, 5), (None, 0)])
    assert branch == "tie: top of chain"
    assert air.agents[1].state.idle
    assert air.agents[1].state.sent["Request for Block"] == 0


@takes("reconcile_phase_2_timer_expiration", "tie: block")
def test_setting_phase2_tie_block_prefers_a_block_in_a_tie() -> None:
    air, branch = phase_2([(A, 5), (None, 0)], phase2_tie="block")
    assert branch == "tie: block"
    assert air.agents[1].state.majority_response_block_hash == A


@pytest.mark.parametrize(
    ("answers", "branch", "chosen"),
    [
        pytest.param([(None, 0), (B, 9), (A, 5)], "tie: block", A, id="as many would refuse as approve"),
        pytest.param([(None, 0), (None, 0), (A, 9), (A, 9), (B, 5)], "block", A, id="the most of those who refuse"),
        pytest.param([(None, 0), (A, 5)], "tie: top of chain", None, id="two to one"),
        pytest.param([(None, 0), (None, 0), (A, 5), (B, 5)], "top of chain", None, id="three to two"),
        pytest.param([(None, 0)], "top of chain", None, id="nobody has a block"),
        pytest.param([(B, 9)], "block", B, id="one to one"),
    ],
)
def test_setting_top_needs_majority_requires_a_majority(
    answers: list[tuple[bytes | None, int]], branch: str, chosen: bytes | None
) -> None:
    air, taken = phase_2(answers, top_needs_majority=True)
    assert taken == branch
    assert air.agents[1].state.majority_response_block_hash == chosen


@takes("receive_response_next_in_sequence", "counted already", "another chain")
def test_phase_2_counts_each_responder_once_for_the_queried_chain() -> None:
    """A repeated answer and an answer about another chain do not count. Therefore the blocks A and B have equally many
    votes, and B is older.
    """
    air = in_phase_2(agents=4)
    agent = air.agents[1]
    top = agent.state.chain.top_chain_hash
    for sender, chain_hash, block_hash, timestamp_us in ((2, top, A, 9), (2, top, A, 9), (3, B, A, 9), (3, top, B, 1)):
        agent.receive_message(sender, 1, NextInSequenceResponse(chain_hash, block_hash, timestamp_us), 6.0)
    air.run_until(10.0)
    assert air.branches(1, "reconcile_phase_2_timer_expiration") == ["tie: block"]
    assert agent.state.majority_response_block_hash == B


@takes("receive_response_block_for_hash", "another block")
def test_other_block_does_not_delay_the_end_of_phase_3() -> None:
    air, _ = phase_2([(A, 5)])  # phase 3 begins at 10 s
    air.agents[1].receive_message(2, 3, BlockResponse(Block(2, 1, b"other")), 13.0)
    assert air.agents[1].next_timer() == 15.0
    air.settle()
    assert air.branches(1, "reconcile_phase_3_timer_expiration") == ["gave up"]


def test_quirk_crash_on_tie_leaves_the_agent_reconciling_forever() -> None:
    air = in_phase_2(agents=3)
    agent = air.agents[1]
    agent.replace_handlers(wrong_handlers({"crash_on_tie": True}, Random(0)))
    top = agent.state.chain.top_chain_hash
    agent.receive_message(2, 1, NextInSequenceResponse(top, A, 5), 6.0)
    agent.receive_message(3, 1, NextInSequenceResponse(top, None, 0), 6.0)
    air.settle()
    assert air.branches(1, "reconcile_phase_2_timer_expiration") == ["crashed by quirk"]
    assert agent.state.reconcile_in_progress
    assert agent.next_timer() is None


def test_quirk_early_phase3_expiry_ends_reconciles_without_a_block() -> None:
    air = diverged()
    agent = air.agents[1]
    agent.replace_handlers(wrong_handlers({"early_phase3_expiry": True}, Random(0)))
    air.reconcile(1)
    assert air.branches(1, "reconcile_phase_3_timer_expiration") == ["gave up"]
    assert set(air.branches(1, "receive_response_block_for_hash")) == {"not in phase 3"}
    assert len(agent.state.chain) == 1
    assert agent.state.idle, "it goes on to take part"
    agent.replace_handlers([])
    air.reconcile(1)
    assert len(agent.state.chain) == 2


def test_quirk_stale_chain_hash_requests_the_same_block_again() -> None:
    air = diverged(blocks_on_2=2)
    agent = air.agents[1]
    agent.replace_handlers(wrong_handlers({"stale_chain_hash": True}, Random(0)))
    air.reconcile(1)
    assert air.branches(1, "receive_response_block_for_hash")[0] == "committed"
    assert air.branches(1, "reconcile_phase_3") == ["asked", "held already"]
    right = accumulate(
        (block.block_hash for block in agent.state.chain),
        next_chain_hash,
        initial=agent.state.chain.inception.chain_hash,
    )
    assert [chain_hash for _, chain_hash in agent.state.chain.with_chain_hashes()] != list(right)[1:]


@takes("reconcile_phase_3", "held already")
def test_block_that_the_agent_holds_is_not_requested() -> None:
    air = Air([1, 2], fate=lambda *_: [])
    air.fill_block(1)
    air.settle()
    agent = air.agents[1]
    (own,) = agent.state.completed
    agent.begin_reconcile(air.now)
    agent.receive_message(2, 0, ChainContainResponse(agent.state.chain.top_chain_hash, True), air.now)
    air.run_until(air.now + 5)
    agent.receive_message(2, 1, NextInSequenceResponse(agent.state.chain.top_chain_hash, own, 1), air.now)
    air.settle()
    assert air.branches(1, "reconcile_phase_3") == ["held already"]
    assert agent.state.sent["Request for Block"] == 0
    assert agent.state.idle


@takes("reconcile_finalize", "recommitted, more to come", "done")
def test_finalize_pauses_between_commits_and_other_agents_follow() -> None:
    air = Air([1, 2, 3], fate=part({1}, {2, 3}))
    for _ in range(3):
        air.fill_block(1)
        air.settle()
    air.fill_block(2)
    air.settle()
    air.fate = uniform_latency(Random(3))
    air.reconcile(1)
    assert air.branches(1, "reconcile_finalize") == ["recommitted, more to come", "recommitted, more to come", "done"]
    recommits = [
        run.t
        for run in air.runs[1]
        if run.handler == "reconcile_finalize" and any(sent.message == "Commit Block" for sent in run.sent)
    ]
    assert [later - earlier for earlier, later in pairwise(recommits)] == pytest.approx([0.1, 0.1])
    assert len(set(air.chains())) == 1
    assert len(air.agents[2].state.chain) == 4


@takes("reconcile_finalize", "done")
def test_without_a_gap_finalize_commits_all_at_once() -> None:
    air = diverged(finalize_gap_s=0.0)
    air.reconcile(1)
    assert air.branches(1, "reconcile_finalize") == ["done"]


@takes("receive_request_chain_contain", "reconcile in progress")
@takes("receive_request_next_in_sequence", "reconcile in progress")
@takes("receive_request_block_for_hash", "reconcile in progress")
@takes("reconcile_begin", "already in progress")
def test_reconciling_agent_answers_no_message_and_does_not_restart() -> None:
    agent = with_blocks(1)
    (block,) = agent.state.chain
    top = agent.state.chain.top_chain_hash
    agent.begin_reconcile(agent.state.now)
    agent.messages_to_send()
    for question in (ChainContainQuery(top), ChainHashSuccessorQuery(top), RequestForBlock(block.block_hash)):
        assert answers(agent, question) == []
    agent.begin_reconcile(agent.state.now + 1)
    assert not agent.messages_to_send()
    assert agent.state.reconciles == 1


def test_divergence_of_50_blocks_is_reconciled() -> None:
    air = Air([1, 2, 3], fate=part({1}, {2, 3}))
    for _ in range(50):
        air.fill_block(1)
        air.fill_block(2)
        air.settle()
    air.fate = uniform_latency(Random(3))
    air.reconcile(1)
    assert len(set(air.chains())) == 1
    assert len(air.agents[1].state.chain) == 100
