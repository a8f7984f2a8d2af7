"""Test the stored data of an agent, and that the agent continues from them after a reboot."""

import errno
import os
from pathlib import Path
from random import Random
from typing import Any

import pytest

from tests.ucp.air import INITIAL_DATA, Air, assert_characteristics_2_to_4, uniform_latency
from ucp.agent import Agent
from ucp.block import Block, next_chain_hash
from ucp.core import Core
from ucp.events import LoggableEvent
from ucp.messages import CommitBlock
from ucp.settings import Settings
from ucp.state import AgentState
from ucp.store import Store, StoredState, StoreError
from ucp.trigger import BootTrigger


class StoringAir(Air):
    """A mission in virtual time in which agent 1 stores its data."""

    def __init__(self, path: Path, loss: float) -> None:
        super().__init__([1, 2, 3], uniform_latency(Random(1), loss=loss))
        self.store = Store(path, self.agents[1].state)

    def flush(self, agent_id: int) -> None:
        before = len(self.runs[agent_id])
        super().flush(agent_id)
        if agent_id == 1:
            self.store.write([change for run in self.runs[1][before:] for change in run.changes])


def a_store(path: Path, blocks: int = 5) -> AgentState:
    """Write the stored data of an agent that has committed `blocks` blocks and completed one more. Return its state."""
    core = Core(1, INITIAL_DATA, Settings())
    store = Store(path, core)
    for number in range(blocks + 1):
        core.complete(Block(1, number, bytes([number])))
        if number < blocks:
            core.commit(core.take_from_deque())
        changes, core.changes = core.changes, []
        store.write(changes)
    store.close()
    return core


def found(path: Path) -> StoredState | None:
    return Store(path, Agent(1, [1, 2], INITIAL_DATA).state).recovered


def test_store_always_equals_the_state_of_the_agent(tmp_path: Path) -> None:
    air = StoringAir(tmp_path / "store", loss=0.4)
    air.generate_events(seed=1, mean_s=5.0)
    kinds = set()
    for step in range(1, 3000):
        air.step()
        agent = air.agents[1]
        if step % 40 == 0 and (agent.state.reconcile_stack or step % 400 == 0):
            stored = Store(tmp_path / "store", Agent(1, [1, 2, 3], INITIAL_DATA).state).recovered
            assert stored == StoredState.of(agent.state)
            kinds |= {kind for kind in ("chain", "deque", "stack") if getattr(stored, kind)}
    assert kinds == {"chain", "deque", "stack"}


def test_booted_agent_has_its_blocks_and_commits_completed_ones() -> None:
    """Power failures during votes and reconciles neither lose nor duplicate a block, even if messages are lost."""
    air = Air([1, 2, 3], uniform_latency(Random(2), loss=0.3))
    air.generate_events(seed=2, mean_s=5.0)
    rng = Random(3)
    aside = 0
    for _ in range(40):
        for _ in range(rng.randrange(1, 80)):
            air.step()
        before = StoredState.of(air.agents[1].state)
        aside += len(before.stack) + len(before.deque)
        air.agents[1] = Agent(1, [1, 2, 3], INITIAL_DATA)
        air.agents[1].boot(before, air.now)
        air.flush(1)
        assert not air.agents[1].state.idle or not (before.stack or before.deque)
        assert {block.block_hash for block in StoredState.of(air.agents[1].state).blocks()} == {
            block.block_hash for block in before.blocks()
        }
        completed_by = {agent_id: set(agent.state.completed) for agent_id, agent in air.agents.items()}
        assert_characteristics_2_to_4(air.agents[1], completed_by)
    assert aside > 20
    air.stop_events()
    air.settle()
    assert_characteristics_2_to_4(
        air.agents[1], {agent_id: set(agent.state.completed) for agent_id, agent in air.agents.items()}
    )


def test_first_run_after_a_boot_lists_all_recovered_blocks() -> None:
    agent = Agent(1, [1, 2], INITIAL_DATA)
    mine, other, waiting, popped = Block(1, 1, b"a"), Block(2, 2, b"b"), Block(1, 3, b"c"), Block(2, 1, b"d")
    agent.boot(StoredState([mine.block_hash, waiting.block_hash], [mine, other], [waiting], [popped]), 60.0)
    first, second = agent.trace()
    assert (first.handler, first.trigger, first.branch) == ("reconcile_finalize", BootTrigger(2), "done")
    hashes = {name: block.block_hash.hex() for name, block in locals().items() if isinstance(block, Block)}
    assert first.changes == [
        ("complete", hashes["mine"]),
        ("complete", hashes["waiting"]),
        ("chain+", hashes["mine"]),
        ("chain+", hashes["other"]),
        ("deque+", hashes["waiting"]),
        ("stack+", hashes["popped"]),
        ("stack-", hashes["popped"]),
        ("chain+", hashes["popped"]),
    ]
    assert (second.handler, second.branch) == ("process_next_deque_block", "proposed")
    assert agent.state.newest_block_timestamp_us == 3


def test_store_with_a_torn_last_entry_keeps_earlier_blocks(tmp_path: Path) -> None:
    path = tmp_path / "store"
    state = a_store(path)
    whole = path.read_bytes()
    assert found(path) == StoredState.of(state)
    last = whole.rfind(b"\n", 0, -1) + 1
    for end in range(last, len(whole) - 1):
        path.write_bytes(whole[:end])
        stored = found(path)
        assert stored is not None
        assert (len(stored.completed), len(stored.chain), len(stored.deque)) == (5, 5, 0)


def test_damaged_byte_ends_the_reading_of_a_store(tmp_path: Path) -> None:
    path = tmp_path / "store"
    a_store(path)
    lines = path.read_bytes().splitlines(keepends=True)
    rng = Random(1)
    for number in range(2, len(lines)):
        damaged = bytearray(lines[number])
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        path.write_bytes(b"".join([*lines[:number], bytes(damaged), *lines[number + 1 :]]))
        stored = found(path)
        assert stored is not None
        assert len(stored.chain) == number - 1


def test_truncated_store_is_valid_after_the_next_entry(tmp_path: Path) -> None:
    path = tmp_path / "store"
    a_store(path)
    path.write_bytes(path.read_bytes()[:-10])
    agent = Agent(1, [1, 2], INITIAL_DATA)
    store = Store(path, agent.state)
    assert store.recovered is not None
    agent.boot(store.recovered, 1.0)
    while agent.state.completed == store.recovered.completed:
        agent.add_event(LoggableEvent(0, 7, bytes(256)), 1.0)
    store.write([change for run in agent.trace() for change in run.changes])
    assert found(path) == StoredState.of(agent.state)
    assert not list(tmp_path.glob(".*"))


def test_store_of_another_agent_or_mission_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "store"
    a_store(path)
    for other in (Agent(2, [1, 2], INITIAL_DATA), Agent(1, [1, 2], b"another mission")):
        with pytest.raises(StoreError, match=r"is the store of agent 1 in another mission.*to another path"):
            Store(path, other.state)


def test_file_that_is_no_store_is_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "precious"
    path.write_text("data\n")
    with pytest.raises(StoreError, match=r"precious is not a store: move the file away"):
        found(path)
    assert path.read_text() == "data\n"
    path.write_text("")
    assert found(path) is None


def test_full_disk_ends_the_store_and_keeps_its_entries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "store"
    state = a_store(path)
    before = path.read_bytes()

    def refuse(_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    again = Agent(1, [1, 2], INITIAL_DATA)
    store = Store(path, again.state)
    assert store.recovered is not None
    monkeypatch.setattr(os, "fdatasync", refuse)
    again.boot(store.recovered, 1.0)
    store.write([change for run in again.trace() for change in run.changes])
    assert store.problem == "No space left on device"
    assert path.read_bytes() == before
    assert not list(tmp_path.glob(".*"))
    assert found(path) == StoredState.of(state)


def test_forged_blocks_do_not_change_the_timestamps_of_own_blocks() -> None:
    agent = Agent(1, [1, 2], b"")
    false = Block(1, 2**64 - 1, b"not mine")
    commit = CommitBlock(false, next_chain_hash(agent.state.chain.top_chain_hash, false.block_hash))
    agent.receive_message(2, 0, commit, 0.0)
    reborn = Agent(1, [1, 2], b"")
    reborn.boot(StoredState.of(agent.state), 1.0)
    for _ in range(3):
        reborn.add_event(LoggableEvent(5, 1, bytes(256)), 2.0)
    assert [block.timestamp_us for block in reborn.state.blocks_to_be_committed] == [5]
