"""Test that the full and the reduced state space agree, and contain all states of random runs."""

from collections.abc import Iterator, Sequence
from functools import cache
from math import inf
from random import Random
from typing import Any

import pytest

from harness.proof import Bounds
from harness.proof.graph._exploration import StateGraph, explore
from harness.proof.graph._workers import Workers
from harness.proof.model._global_states import AGENTS, ModelSwarm
from harness.proof.model._known_states import DEAD
from harness.proof.model._snapshot import key_of, put_back, take
from harness.proof.questions import _convergence
from harness.scenario.agent_options import Stagger, staggered
from ucp.agent import Agent
from ucp.clock import MICROSECONDS
from ucp.events import LoggableEvent
from ucp.settings import Settings

View = tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...], bool, tuple[str, ...]]
Seen = tuple[View, ...]


def explored(*arguments: Any, **options: Any) -> StateGraph:
    graph = explore(ModelSwarm(Bounds(*arguments, **options)), most_bytes=8e9, most_s=600)
    assert graph.ended == "complete"
    return graph


def view_of(agent: Agent) -> View:
    """Return the visible state of an agent.

    It consists of the blocks in each list of the agent, and of the running timers.
    """
    return (
        tuple(block.timestamp_us // MICROSECONDS for block in agent.state.chain),
        tuple(block.timestamp_us // MICROSECONDS for block in agent.state.blocks_to_be_committed),
        tuple(block.timestamp_us // MICROSECONDS for block in agent.state.reconcile_stack),
        agent.state.reconcile_in_progress,
        tuple(timer.name for timer in agent.state.timers if timer.deadline is not None),
    )


def seen_of(agents: Sequence[Agent]) -> Seen:
    """Return the visible states of agents in sorted order, so that their IDs make no difference."""
    return tuple(sorted(map(view_of, agents)))


def by_place(graph: StateGraph) -> set[Seen]:
    """Return, for each state of the graph, the visible states of its living agents in the order of their IDs."""
    local = graph.swarm.local
    agent = Agent(1, range(1, graph.swarm.bounds.agents + 1), b"proof", local.settings)

    @cache
    def view(number: int) -> View:
        put_back(agent, local.known[number].snapshot)
        return view_of(agent)

    return {tuple([view(number) for number in state[AGENTS:] if number != DEAD]) for state in graph.states}


def all_seen(graph: StateGraph) -> set[Seen]:
    return {tuple(sorted(seen)) for seen in by_place(graph)}


@pytest.mark.parametrize(
    ("agents", "blocks", "network", "faults"),
    [
        (2, 3, "lossless", ()),
        (2, 2, "lossy", ("reboot", "duplicate")),
        (3, 2, "lossless", ("death",)),
        (4, 2, "lossless", ()),
    ],
)
def test_reduced_and_whole_state_spaces_are_equal(
    agents: int, blocks: int, network: Any, faults: tuple[str, ...]
) -> None:
    reduced = explored(agents, blocks, network, faults)
    whole = explored(agents, blocks, network, faults, reduced=False)
    assert len(reduced.states) < len(whole.states)
    assert all_seen(reduced) == all_seen(whole)


@pytest.mark.parametrize("network", ["lossless", "lossy"])
def test_reduction_of_tallies_changes_no_result(network: Any) -> None:
    in_one, in_every = ModelSwarm(Bounds(3, 2, network)), ModelSwarm(Bounds(3, 2, network), every_count=True)
    one, every = (explore(swarm, most_bytes=8e9, most_s=600) for swarm in (in_one, in_every))
    assert in_one.local.steps < in_every.local.steps
    assert len(one.states) <= len(every.states)
    assert all_seen(one) == all_seen(every)


@pytest.mark.parametrize(
    ("bounds", "most_told"),
    [
        (Bounds(3, 2, "lossy", ("reboot",)), 500_000),
        (Bounds(3, 2, "lossy", ("reboot",)), 1),
        (Bounds(3, 2, "lossy", stagger={"phase1_timeout_s": 0.5}, clocks_any=True), 500_000),
        (Bounds(3, 2, "lossy", ("reboot",), zones_contained=True), 500_000),
    ],
)
def test_two_cores_give_the_result_of_one(bounds: Bounds, most_told: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.proof.graph._workers.WORTH_WORKERS", 10)
    monkeypatch.setattr("harness.proof.graph._workers.MAX_REPORTED", most_told)
    alone = explore(ModelSwarm(bounds), most_bytes=8e9, most_s=600)
    swarm = ModelSwarm(bounds)
    with Workers(swarm, 2) as workers:
        shared = explore(swarm, most_bytes=8e9, most_s=600, workers=workers)
        assert _convergence.look(shared, workers=workers) == _convergence.look(alone)
    assert shared.workers_steps > 0
    assert shared.ended == alone.ended == "complete"
    assert shared.parents == alone.parents
    assert [*shared.quiet] == [*alone.quiet]
    assert shared.crossing == alone.crossing
    assert shared.transitions == alone.transitions
    names = [
        [[graph.swarm.local.known[local].anonymous for local in state[AGENTS:]] for state in graph.states]
        for graph in (alone, shared)
    ]
    assert names[0] == names[1]


@pytest.mark.parametrize(("agents", "blocks", "loss"), [(2, 3, 0.4), (3, 2, 0.4), (3, 2, 0.0)])
def test_random_runs_are_contained(agents: int, blocks: int, loss: float) -> None:
    seen = all_seen(explored(agents, blocks, "lossy" if loss else "lossless"))
    for seed in range(60):
        for there in by_chance(agents, blocks, loss, Random(seed)):
            assert there in seen


def by_chance(
    count: int,
    blocks: int,
    loss: float,
    lots: Random,
    *,
    clocks_apart: bool = False,
    most_lost: float = inf,
    stagger: Stagger | None = None,
) -> Iterator[Seen]:
    """Play a random run, and yield the visible states whenever no message is in transit.

    If clocks differ, the timestamps of the agents are years apart. `most_lost` limits the number of lost messages.
    """
    settings = [staggered(Settings(max_block_bytes=267), stagger or {}, place) for place in range(count)]
    roster = range(1, count + 1)
    agents = [Agent(own_id, roster, b"proof", own) for own_id, own in zip(roster, settings, strict=True)]
    completed = sorted(lots.uniform(0, 40) if lots.random() < 0.7 else 5.0 * lots.randint(0, 6) for _ in range(blocks))
    ordinal = 0
    ahead = [index * clocks_apart for index in lots.sample(range(count), count)]
    while True:
        soonest = min(
            ((at, agent) for agent in agents if (at := agent.next_timer()) is not None), default=None, key=first
        )
        if ordinal < blocks and (soonest is None or completed[ordinal] <= soonest[0]):
            now = completed[ordinal]
            ordinal += 1
            acted = lots.choice(agents)
            shown = ordinal + blocks * ahead[acted.agent_id - 1]
            acted.add_event(LoggableEvent(shown * MICROSECONDS, 1, bytes(256)), now)
        elif soonest is not None and soonest[0] < 300:
            now, acted = soonest
            timer = min((timer for timer in acted.state.timers if timer.deadline is not None), key=lambda t: t.deadline)
            acted.end_timer(timer, now)
        else:
            return
        most_lost -= deliver(agents, loss, now, lots, most_lost)
        yield seen_of(agents)


def deliver(agents: Sequence[Agent], loss: float, now: float, lots: Random, most_lost: float = inf) -> int:
    """Deliver the messages, and return the number of those that were lost."""
    lost = 0
    while said := [(agent, sent) for agent in agents for sent in agent.messages_to_send()]:
        for receiver in agents:
            for sender, (sequence, message) in said:
                if sender is receiver:
                    continue
                if lost < most_lost and lots.random() < loss:
                    lost += 1
                else:
                    receiver.receive_message(sender.agent_id, sequence, message, now)
    return lost


def first(pair: tuple[float, Agent]) -> float:
    return pair[0]


def test_snapshot_contains_the_whole_state() -> None:
    agents = [Agent(agent_id, (1, 2), b"proof", Settings(max_block_bytes=267)) for agent_id in (1, 2)]
    names: dict[bytes, int] = {}
    keys = []
    for number in (1, 2, 3):
        agents[0].add_event(LoggableEvent(number, 1, bytes(256)), float(number))
        keys.append(key_of(take(agents[0]), lambda digest: names.setdefault(digest, len(names))))
    assert len(set(keys)) == 3
    snapshot = take(agents[0])
    put_back(agents[0], snapshot)
    assert key_of(take(agents[0]), names.__getitem__) == keys[-1]
    assert agents[0].state.voting_timer.active


def test_snapshot_refuses_an_unknown_attribute() -> None:
    agent = Agent(1, (1, 2), b"proof")
    vars(agent.state)["new"] = object()
    with pytest.raises(TypeError, match="object"):
        take(agent)
