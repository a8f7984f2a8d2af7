"""Test the timer, the chain and the state of the reference implementation."""

from hashlib import sha256

import pytest

from harness.checker.reference.algorithms import HANDLERS, ON_LOCAL_EVENT, ON_MESSAGE, ON_TIMER
from harness.checker.reference.state import Chain, ReferenceState, Settings, Timer
from tests.harness.checker.reference.driver import OTHER_HASH, block_of, complete, new_agent
from ucp.block import Block, InceptionBlock
from ucp.events import LoggableEvent


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
