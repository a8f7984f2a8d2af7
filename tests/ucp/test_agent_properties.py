"""Test properties that hold after each step of an agent, for any behaviour of the radio, the clock and other agents."""

import base64
import pickle
from random import Random

from hypothesis import given, settings
from hypothesis import strategies as st

from tests.ucp.air import Air, assert_characteristics_2_to_4
from tests.ucp.test_messages import messages
from ucp.agent import HANDLERS, Agent
from ucp.block import Block, next_chain_hash
from ucp.messages import CommitBlock, Message, decode, encode
from ucp.quirks import wrong_handlers
from ucp.store import StoredState
from ucp.trace import DroppedDatagram


def state_of(agent: Agent) -> bytes:
    """Return the agent's state without the counters of received and dropped datagrams."""
    state = {name: value for name, value in vars(agent.state).items() if name not in ("now", "running")}
    return pickle.dumps({**state, "chain": vars(agent.state.chain), "trace": vars(agent)["_trace"]})


hostile = st.one_of(
    st.binary(max_size=1600),
    st.tuples(messages, st.integers(0, 200)).map(lambda pair: encode(2, 0, pair[0])[: pair[1]]),
    messages.map(lambda message: encode(2, 0, message) + b"\0"),
    messages.map(lambda message: b"XX" + encode(2, 0, message)[2:]),
    messages.map(lambda message: encode(2, 0, message)[:2] + b"\7" + encode(2, 0, message)[3:]),
    messages.map(lambda message: encode(2, 0, message)[:3] + b"\x63" + encode(2, 0, message)[4:]),
    messages.map(lambda message: encode(1, 0, message)),  # our own ID
    messages.map(lambda message: encode(99, 0, message)),  # not on the roster
)


@given(st.lists(hostile, min_size=1, max_size=20), st.booleans())
def test_hostile_datagram_is_counted_and_changes_no_state(datagrams: list[bytes], reconciling: bool) -> None:
    air = Air([1, 2])
    air.fill_block(1)
    agent = air.agents[1]
    if reconciling:
        agent.begin_reconcile(0.0)
    agent.trace()
    before = state_of(agent)
    acceptable = 0
    for datagram in datagrams:
        try:
            sender, _, _ = decode(datagram)
            acceptable += sender == 2  # a cut that removed nothing
        except ValueError:
            pass
        if acceptable:
            return
        agent.receive_datagram(datagram, 1.0)
    assert sum(agent.dropped.values()) == len(datagrams)
    assert not agent.received
    assert [entry.datagram.text for entry in agent.trace() if isinstance(entry, DroppedDatagram)] == [
        base64.b64encode(datagram).decode() for datagram in datagrams
    ]
    assert state_of(agent) == before


def test_block_of_an_agent_outside_the_roster_is_dropped() -> None:
    agent = Agent(1, [1, 2], b"")
    block = Block(3, 1, b"x")
    commit = CommitBlock(block, next_chain_hash(agent.state.chain.top_chain_hash, block.block_hash))
    agent.receive_datagram(encode(2, 0, commit), 0.0)
    assert agent.dropped == {"block not of the roster": 1}
    assert len(agent.state.chain) == 0


@given(st.lists(messages, max_size=30), st.integers(0, 3))
def test_false_messages_never_break_characteristics_2_and_3(lies: list[Message], blocks: int) -> None:
    air = Air(range(1, 65), fate=lambda *_: [])
    for _ in range(blocks):
        air.fill_block(1)
    for number, lie in enumerate(lies):
        agent = air.agents[1]
        agent.receive_message(2 + number % 60, number, lie, air.now)
        air.run_until(air.now + 3)
        held = [block.block_hash for block in StoredState.of(agent.state).blocks()]
        assert len(held) == len(set(held))
        assert not agent.state.idle or set(agent.state.completed) <= {block.block_hash for block in agent.state.chain}


@settings(max_examples=60)
@given(
    agents=st.integers(1, 7),
    loss=st.sampled_from([0.0, 0.1, 0.3, 0.6, 1.0]),
    duplication=st.sampled_from([0.0, 0.3]),
    latency_s=st.sampled_from([0.05, 3.0, 12.0]),  # 12 s: votes arrive in later rounds, commits overtake commits
    mean_s=st.sampled_from([2.0, 10.0]),
    quirk=st.sampled_from([0.0, 0.3]),
    seed=st.integers(0, 2**32),
)
def test_characteristics_2_to_4_hold_after_every_step(
    agents: int, loss: float, duplication: float, latency_s: float, mean_s: float, quirk: float, seed: int
) -> None:
    rng = Random(seed)

    def fate(sender: int, receiver: int, message: Message) -> list[float]:
        copies = 0 if rng.random() < loss else 1 + (rng.random() < duplication)
        return [rng.uniform(0.001, latency_s) for _ in range(copies)]

    air = Air(range(1, agents + 1), fate)
    for agent in air.agents.values():
        agent.replace_handlers(wrong_handlers({"ignore_commit": quirk}, Random(0)))
    air.generate_events(seed, mean_s)
    for _ in range(400):
        if air.now > 150:
            air.stop_events()
        if not air.step():
            break
        completed_by = {agent_id: set(agent.state.completed) for agent_id, agent in air.agents.items()}
        for agent in air.agents.values():
            assert_characteristics_2_to_4(agent, completed_by)


@settings(max_examples=25)
@given(loss=st.sampled_from([0.0, 0.15, 0.5]), seed=st.integers(0, 2**32))
def test_equal_inputs_give_equal_outputs_and_a_trace_replays(loss: float, seed: int) -> None:
    def run() -> Air:
        rng = Random(seed)
        air = Air(range(1, 5), lambda *_: [] if rng.random() < loss else [rng.uniform(0.002, 0.05)])
        air.generate_events(seed, mean_s=5.0)
        air.run_until(200)
        return air

    first, second = run(), run()
    for agent_id, agent in first.agents.items():
        lines = [handler_run.to_line() for handler_run in first.runs[agent_id]]
        assert lines == [handler_run.to_line() for handler_run in second.runs[agent_id]]
        held: dict[str, list[str]] = {"chain": [], "deque": [], "stack": []}
        for handler_run in first.runs[agent_id]:
            assert handler_run.branch in HANDLERS[handler_run.handler].branches
            for operation, block_hash in handler_run.changes:
                if operation.endswith("+"):
                    held[operation[:-1]].append(block_hash)
                elif operation.endswith("-"):
                    held[operation[:-1]].remove(block_hash)
            assert {name: len(hashes) for name, hashes in held.items()} == {
                name: getattr(handler_run.state, name) for name in held
            }
        assert held["chain"] == [block.block_hash.hex() for block in agent.state.chain]
