"""Test Algorithms 1 to 6, handler by handler."""

from random import Random

import pytest

from tests.ucp.air import Air, uniform_latency
from tests.ucp.branches import takes
from ucp.block import Block, next_chain_hash
from ucp.events import LoggableEvent, decode_events
from ucp.messages import BlockAddRequest, BlockAddResponse, CommitBlock, Message
from ucp.quirks import check_quirk, wrong_handlers
from ucp.settings import Settings


def without(dropped: type[Message]):
    latency = uniform_latency(Random(1))
    return lambda sender, receiver, message: [] if isinstance(message, dropped) else latency(sender, receiver, message)


@takes("build_data_block", "building", "full")
def test_block_is_full_if_the_largest_event_may_not_fit() -> None:
    air = Air([1])
    agent = air.agents[1]
    for _ in range(2):
        air.log(1, bytes(256))
    assert not agent.state.completed  # 2 * 267 + 267 < 1024
    air.now = 3.5
    air.log(1, bytes(256))  # 3 * 267 + 267 >= 1024
    (block,) = agent.state.blocks_to_be_committed
    assert [len(event.data) for event in decode_events(block.event_data)] == [256] * 3
    assert block.timestamp_us == 3_500_000  # the time of the newest event
    assert agent.state.current_block == b""


def test_blocks_completed_in_the_same_microsecond_still_differ() -> None:
    air = Air([1])
    assert air.fill_block(1) != air.fill_block(1)


def test_no_block_is_later_than_the_latest_timestamp() -> None:
    agent = Air([1]).agents[1]
    for number in range(6):
        agent.add_event(LoggableEvent(2**64 - 1, 1 + number, bytes(256)), 0.0)
    assert [block.timestamp_us for block in agent.state.blocks_to_be_committed] == [2**64 - 1] * 2


def test_event_above_max_event_bytes_is_refused() -> None:
    agent = Air([1]).agents[1]
    with pytest.raises(ValueError, match="max_event_bytes 267"):
        agent.add_event(LoggableEvent(0, 1, bytes(257)), 0.0)


@takes("process_next_deque_block", "proposed")
def test_full_block_is_proposed_on_top_of_the_own_chain() -> None:
    air = Air([1, 2])
    air.fill_block(2)
    air.settle()
    agent = air.agents[1]
    while not agent.state.completed:
        agent.add_event(LoggableEvent(0, 7, bytes(256)), air.now)
    proposal = BlockAddRequest(agent.state.completed[0], agent.state.chain.top_chain_hash)
    assert agent.messages_to_send() == [(1, proposal)]  # 0 was its approval of 2's
    assert agent.state.vote_count == {"yes": 1, "no": 0}  # its own vote
    assert agent.next_timer() == air.now + 10.0


@takes("receive_request_add_block", "approve", "disapprove")
def test_agent_approves_a_block_on_top_of_its_own_chain() -> None:
    agent = Air([1, 2]).agents[1]
    for chain_hash in (agent.state.chain.top_chain_hash, bytes(32)):
        agent.receive_message(2, 0, BlockAddRequest(b"\1" * 32, chain_hash), 0.0)
    approval, disapproval = (message for _, message in agent.messages_to_send())
    assert approval == BlockAddResponse(b"\1" * 32, approve=True)
    assert disapproval == BlockAddResponse(b"\1" * 32, approve=False)


@takes("process_next_deque_block", "deque empty")
def test_agent_without_neighbours_commits_its_blocks_after_the_vote() -> None:
    air = Air([1, 2], fate=lambda *_: [])
    block_hash = air.fill_block(1)
    air.run_until(9.99)
    assert block_hash not in air.agents[1].state.chain
    air.run_until(10.0)
    assert block_hash in air.agents[1].state.chain
    assert air.agents[1].state.idle
    assert air.agents[1].state.sent["Block Add Request"] == 1


@takes("receive_vote_add_block", "yes")
@takes("vote_timer_expiration", "approved")
@takes("receive_commit_block", "committed")
def test_all_agents_commit_an_approved_block() -> None:
    air = Air(range(1, 6))
    block_hash = air.fill_block(3)
    air.settle()
    assert air.chains() == [(block_hash,)] * 5
    assert all(agent.state.reconciles == 0 for agent in air.agents.values())


@takes("process_next_deque_block", "vote running")
def test_blocks_wait_their_turn_while_a_vote_runs() -> None:
    air = Air([1, 2], fate=lambda *_: [])
    first = air.fill_block(1)
    air.run_until(4.0)
    second = air.fill_block(1)
    assert air.branches(1, "process_next_deque_block") == ["proposed", "vote running"]
    air.run_until(10.0)
    assert [block.block_hash for block in air.agents[1].state.chain] == [first]
    air.run_until(20.0)
    assert [block.block_hash for block in air.agents[1].state.chain] == [first, second]


@takes("receive_vote_add_block", "no", "counted already", "another block")
def test_responder_counts_once_per_round() -> None:
    air = Air([1, 2, 3], fate=lambda *_: [])
    block_hash = air.fill_block(1)
    agent = air.agents[1]
    for _ in range(3):
        agent.receive_message(2, 0, BlockAddResponse(block_hash, approve=False), 1.0)
    agent.receive_message(3, 0, BlockAddResponse(bytes(32), approve=False), 1.0)
    assert agent.state.vote_count == {"yes": 1, "no": 1}
    air.flush(1)
    assert air.branches(1, "receive_vote_add_block") == ["no", "counted already", "counted already", "another block"]


@takes("receive_vote_add_block", "no vote running")
def test_vote_after_the_timer_does_not_count() -> None:
    air = Air([1, 2], fate=lambda *_: [])
    block_hash = air.fill_block(1)
    air.settle()
    air.agents[1].receive_message(2, 0, BlockAddResponse(block_hash, approve=True), air.now)
    air.flush(1)
    assert air.branches(1, "receive_vote_add_block") == ["no vote running"]
    assert air.agents[1].state.vote_count == {"yes": 1, "no": 0}


@takes("vote_timer_expiration", "not approved")
def test_tied_vote_is_not_approved() -> None:
    air = Air([1, 2], fate=lambda *_: [])
    block_hash = air.fill_block(1)
    air.agents[1].receive_message(2, 0, BlockAddResponse(block_hash, approve=False), 1.0)
    air.run_until(10.0)
    assert air.branches(1, "vote_timer_expiration") == ["not approved"]
    assert air.agents[1].state.reconcile_in_progress


@takes("vote_timer_expiration", "reconcile in progress")
def test_vote_that_ends_during_a_reconcile_is_repeated_after_it() -> None:
    air = Air([1, 2], fate=lambda *_: [])
    block_hash = air.fill_block(1)
    agent = air.agents[1]
    agent.begin_reconcile(7.0)  # phase 1 ends at 12, the vote at 10
    air.run_until(11.0)
    assert air.branches(1, "vote_timer_expiration") == ["reconcile in progress"]
    assert [block.block_hash for block in agent.state.blocks_to_be_committed] == [block_hash]
    assert agent.state.sent["Commit Block"] == 0
    air.settle()
    assert air.now == 22.0
    assert air.chains()[0] == (block_hash,)


@takes("vote_timer_expiration", "chain changed")
def test_approved_vote_is_repeated_if_the_chain_changed_meanwhile() -> None:
    """If the vote were not repeated, the agent would become idle with a block in its deque (characteristic 2)."""
    air = Air([1, 2, 3])
    first = air.fill_block(1)
    air.run_until(5.0)
    second = air.fill_block(2)
    air.settle()
    assert air.branches(2, "vote_timer_expiration") == ["chain changed", "approved"]
    assert air.chains() == [(first, second)] * 3
    assert air.agents[2].state.reconciles == 0


@pytest.mark.parametrize(
    ("changed_before_tally", "expected"),
    [
        pytest.param(False, "not approved", marks=takes("vote_timer_expiration", "not approved")),
        pytest.param(True, "chain changed", marks=takes("vote_timer_expiration", "chain changed")),
    ],
)
def test_setting_changes_the_order_of_the_tests_of_algorithm_5(changed_before_tally: bool, expected: str) -> None:
    settings = Settings(changed_before_tally=changed_before_tally)
    air = Air([1, 2], fate=lambda *_: [], settings=settings)
    block_hash = air.fill_block(1)
    agent = air.agents[1]
    agent.receive_message(2, 0, BlockAddResponse(block_hash, approve=False), 1.0)
    other = Air([1, 2])
    other.fill_block(2)
    other.settle()
    (committed,) = other.agents[2].state.chain
    agent.receive_message(2, 1, CommitBlock(committed, other.agents[2].state.chain.top_chain_hash), 2.0)
    air.run_until(10.0)
    assert air.branches(1, "vote_timer_expiration") == [expected]


@pytest.mark.parametrize(
    ("names_chain", "yes"),
    [
        pytest.param(False, 2, marks=takes("receive_vote_add_block", "yes")),
        pytest.param(True, 1, marks=takes("receive_vote_add_block", "another round")),
    ],
)
def test_late_vote_of_an_earlier_round_counts_unless_votes_name_the_chain(names_chain: bool, yes: int) -> None:
    air = Air([1, 2, 3], fate=lambda *_: [], settings=Settings(vote_names_chain=names_chain))
    block_hash = air.fill_block(1)
    earlier_round = BlockAddResponse(block_hash, True, b"\1" * 32)
    air.agents[1].receive_message(2, 0, earlier_round, 1.0)
    assert air.agents[1].state.vote_count["yes"] == yes


@takes("reconcile_finalize", "asked who follows")
def test_agent_that_missed_a_commit_reconciles_after_asks_after_commit() -> None:
    air = Air([1, 2, 3], settings=Settings(asks_after_commit=True))
    air.fate = lambda _, to, message: [] if to == 2 and isinstance(message, CommitBlock) else [0.01]
    air.fill_block(1)
    air.settle()
    assert air.branches(1, "reconcile_finalize") == ["asked who follows"]
    assert air.branches(2, "receive_request_next_in_sequence") == ["diverged"]
    assert len({agent.state.chain.top_chain_hash for agent in air.agents.values()}) == 1


def test_reconcile_in_the_gap_replaces_the_query_of_asks_after_commit() -> None:
    air = Air([1], settings=Settings(asks_after_commit=True))
    air.fill_block(1)
    air.run_until(10.0)
    agent = air.agents[1]
    assert agent.state.finalize_timer.active
    agent.begin_reconcile(10.05)
    assert not agent.state.finalize_timer.active
    assert agent.state.reconcile_in_progress


@takes("receive_request_add_block", "disapprove")
@takes("receive_commit_block", "does not succeed")
def test_commit_of_a_block_that_does_not_follow_the_top_is_ignored() -> None:
    latency = uniform_latency(Random(1))
    lose_first_commit_to_3 = lambda s, r, m: [] if isinstance(m, CommitBlock) and r == 3 else latency(s, r, m)  # noqa: E731
    air = Air([1, 2, 3], fate=lose_first_commit_to_3)
    air.fill_block(1)
    air.settle()
    air.fate = latency
    air.fill_block(1)
    air.run_until(air.now + 11)
    assert air.branches(3, "receive_commit_block") == ["does not succeed"]
    assert len(air.agents[3].state.chain) == 0


@takes("receive_commit_block", "held already")
def test_second_copy_of_a_block_is_never_committed() -> None:
    """No correct agent sends a second copy. Characteristic 3 holds even if an agent does."""
    air = Air([1, 2])
    air.fill_block(2)
    air.settle()
    agent = air.agents[1]
    (block,) = agent.state.chain
    again = CommitBlock(block, next_chain_hash(agent.state.chain.top_chain_hash, block.block_hash))
    agent.receive_message(2, 9, again, air.now)
    air.flush(1)
    assert air.branches(1, "receive_commit_block") == ["committed", "held already"]
    assert len(agent.state.chain) == 1


def test_ignore_commit_quirk_misses_commits() -> None:
    air = Air([1, 2])
    air.agents[2].replace_handlers(wrong_handlers({"ignore_commit": 1.0}, Random(0)))
    air.fill_block(1)
    air.settle()
    assert air.branches(2, "receive_commit_block") == ["ignored by quirk"]
    assert [len(chain) for chain in air.chains()] == [1, 0]


@takes("process_next_deque_block", "reconcile in progress")
@takes("receive_request_add_block", "reconcile in progress")
@takes("receive_commit_block", "reconcile in progress")
def test_reconciling_agent_neither_votes_nor_commits_nor_proposes() -> None:
    air = Air([1, 2], fate=lambda *_: [])
    agent = air.agents[1]
    agent.begin_reconcile(0.0)
    air.fill_block(1)
    top, block = agent.state.chain.top_chain_hash, Block(2, 1, b"x")
    agent.receive_message(2, 0, BlockAddRequest(block.block_hash, top), 1.0)
    agent.receive_message(2, 1, CommitBlock(block, next_chain_hash(top, block.block_hash)), 1.0)
    assert agent.state.sent == {"Chain Contain Query": 1}
    assert not agent.state.voting_timer.active
    assert len(agent.state.chain) == 0


@pytest.mark.parametrize(
    ("name", "value"), [("ignore_commit", 1.5), ("ignore_commit", True), ("crash_on_tie", 1), ("fly", True)]
)
def test_impossible_quirk_is_refused(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        check_quirk(name, value)


@pytest.mark.parametrize(
    "wrong",
    [
        {"vote_timeout_s": 0},
        {"phase2_timeout_s": float("nan")},
        {"finalize_gap_s": -1},
        {"max_block_bytes": 1025},
        {"max_event_bytes": 0},
        {"phase1_tie": "coin"},
    ],
)
def test_impossible_settings_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Settings(**wrong)
