"""Test proofs with an attacker who has the keys of a vehicle.

The prover explores all possible messages of the attacker, and simulated runs confirm the results.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import pytest

from harness.errors import ScenarioError
from harness.play.process.process_preflight import refuse_virtual_time_keys
from harness.play.rogue.lies import made_block
from harness.proof import Bounds, BoundsError, in_words, prove
from harness.proof.attacker._attacker import Attacker
from harness.proof.attacker._forgeries import NOBODYS, ForgeryMaterial, PendingQuestions, asked, forgeries
from harness.proof.examples._path_script import PathScript
from harness.proof.graph._exploration import StateGraph, explore
from harness.proof.model._any_sender import collect
from harness.proof.model._global_states import AGENTS, LEFT, LIES, ONCE, ModelSwarm
from harness.proof.model._known_states import DEAD
from harness.proof.model._local_steps import LocalStates
from harness.proof.model._shape import HeldBlockOrder, shape_of
from harness.proof.model._snapshot import NOW_S, put_back, take
from harness.run.simulate import simulate
from harness.scenario.load import parse
from tests.harness.command import harness, sentences
from tests.harness.proof.test_explore import all_seen, deliver, seen_of
from ucp.agent import Agent
from ucp.block import Block, next_chain_hash
from ucp.clock import MICROSECONDS
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
from ucp.secure._signatures import BlockSignatures
from ucp.secure.secured_agent import SecuredAgent
from ucp.settings import Settings

CAPTURED = 3


@cache
def explored(agents: int = 3, blocks: int = 1, lies: int = 1) -> StateGraph:
    swarm = ModelSwarm(Bounds(agents, blocks, "lossy", captured=agents, lies=lies))
    graph = explore(swarm, most_bytes=8e9, most_s=600)
    assert graph.ended == "complete"
    return graph


def lied_to(graph: StateGraph) -> Iterator[tuple[Agent, ForgeryMaterial]]:
    """Yield each agent in each state in which the attacker can send another message to it."""
    bounds, local = graph.swarm.bounds, graph.swarm.local
    attacker = Attacker(replace(bounds, lies=bounds.lies + 1), local)
    pairs = {
        (state[AGENTS + place], place, material)
        for state in graph.states
        if not state[LEFT] >> ONCE.index("captured") & 1
        for place, material in attacker.material(state[AGENTS:])
    }
    for number, place, material in sorted(pairs, key=lambda pair: pair[:2]):
        agent = Agent(place + 1, range(1, graph.swarm.bounds.agents + 1), b"proof", local.settings)
        put_back(agent, local.known[number].snapshot)
        yield agent, material


def random_message(lots: Random, agent: Agent, material: ForgeryMaterial) -> Message:
    """Return a random message of an attacker who knows the blocks in `material` and can create other blocks."""
    made = Block(CAPTURED, lots.randrange(2_000_000), lots.randbytes(20))
    blocks = [*material.blocks, made]
    hashes = [*material.named, made.block_hash, lots.randbytes(32)]
    chain = agent.state.chain
    tops = [chain.inception.chain_hash, *(chain_hash for _, chain_hash in chain.with_chain_hashes())]
    tops += [waits.contains for waits in material.others if waits.contains is not None]
    tops += [waits.successor for waits in material.others if waits.successor is not None]
    tops += [waits.vote[1] for waits in material.others if waits.vote is not None]
    tops += [next_chain_hash(top, lots.choice(hashes)) for top in tops] + [lots.randbytes(32), NOBODYS]
    block, block_hash, chain_hash = lots.choice(blocks), lots.choice(hashes), lots.choice(tops)
    yes = lots.random() < 0.5
    return lots.choice(
        [
            BlockAddRequest(block_hash, chain_hash),
            BlockAddResponse(block_hash, yes, lots.choice([None, chain_hash])),
            CommitBlock(block, lots.choice([chain_hash, next_chain_hash(chain.top_chain_hash, block.block_hash)])),
            ChainContainQuery(chain_hash),
            ChainContainResponse(chain_hash, yes),
            ChainHashSuccessorQuery(chain_hash),
            NextInSequenceResponse(chain_hash, lots.choice([None, block_hash]), lots.randrange(3_000_000)),
            RequestForBlock(block_hash),
            BlockResponse(block),
        ]
    )


def outcome(agent: Agent, message: Message, others: frozenset[PendingQuestions]) -> Any:
    """Return the agent's state after a message of the attacker, and the parts of its sent messages that matter to
    waiting agents.

    New blocks have neutral names. The agent is then restored to its earlier state.
    """
    before = take(agent)
    agent.receive_message(CAPTURED, 0, message, NOW_S)
    state = agent.state
    shape = shape_of(state, held := HeldBlockOrder(state))
    counted = sorted(state.voters), sorted(state.reconcile_responders), sorted(state.vote_count.items())
    said = [sent for _, sent in agent.messages_to_send() if matters(sent, others)]
    put_back(agent, before)
    return held.number(shape), counted, said


def matters(message: Message, others: frozenset[PendingQuestions]) -> bool:
    match message:
        case BlockAddResponse():
            return any(waits.vote is not None and waits.vote[0] == message.block_hash for waits in others)
        case ChainContainResponse():
            return any(waits.contains == message.chain_hash for waits in others)
        case NextInSequenceResponse():
            return any(waits.successor == message.chain_hash for waits in others)
        case BlockResponse():
            return any(waits.block == message.block.block_hash for waits in others)
    return True


def test_random_message_has_the_effect_of_one_of_the_forgeries() -> None:
    lots, changed = Random(20), 0
    for agent, material in lied_to(explored()):
        nothing = outcome(agent, ChainContainQuery(NOBODYS), material.others)
        known = [
            nothing,
            *(outcome(agent, said, material.others) for said in forgeries(agent.state, CAPTURED, material)),
        ]
        for _ in range(80):
            message = random_message(lots, agent, material)
            came = outcome(agent, message, material.others)
            changed += came != nothing
            assert came in known, message
    assert changed > 500


def test_reduced_and_whole_state_spaces_are_equal() -> None:
    reduced, whole = (
        explored(2, 2),
        explore(ModelSwarm(Bounds(2, 2, "lossy", captured=2, reduced=False)), most_bytes=8e9, most_s=600),
    )
    assert len(reduced.states) < len(whole.states)
    assert all_seen(reduced) == all_seen(whole)


def test_random_attacks_are_contained() -> None:
    seen = all_seen(explored())
    for seed in range(200):
        for there in by_chance(Random(seed)):
            assert there in seen


def by_chance(lots: Random) -> Iterator[Any]:
    """Play a random run. Three agents complete one block, and the attacker sends one forged message from a captured
    vehicle.
    """
    agents = [Agent(number, (1, 2, 3), b"proof", Settings(max_block_bytes=267)) for number in (1, 2, 3)]
    times = {lots.uniform(0, 30): what for what in ("completes", "captured", "lies")}
    while True:
        soonest = min(
            ((at, agent.agent_id) for agent in agents if (at := agent.next_timer()) is not None), default=None
        )
        now = min(times, default=None)
        if now is not None and (soonest is None or now <= soonest[0]):
            what = times.pop(now)
            if what == "completes":
                lots.choice(agents).add_event(LoggableEvent(MICROSECONDS, 1, bytes(256)), now)
            elif what == "captured":
                agents = agents[:2]
            elif len(agents) == 2:
                lie(agents, now, lots)
        elif soonest is not None and soonest[0] < 200:
            now, acts = soonest
            agents[acts - 1].handle_timer(now)
        else:
            return
        deliver(agents, 0.3, now, lots)
        yield seen_of(agents)


def lie(agents: list[Agent], now: float, lots: Random) -> None:
    """Send a random forged message to some of the agents."""
    attacker = ModelSwarm(Bounds(3, 1, captured=CAPTURED)).attacker
    assert attacker is not None
    held = [frozenset((*agent.state.chain, *agent.state.reconcile_stack)) for agent in agents]
    named = [block.block_hash for agent in agents for block in agent.state.blocks_to_be_committed]
    blocks = frozenset(attacker.made.values()).union(*held)
    material = ForgeryMaterial(
        blocks,
        frozenset({*named, *(block.block_hash for block in blocks)}),
        frozenset(map(asked, [agent.state for agent in agents])),
        (),
    )
    message = random_message(lots, lots.choice(agents), material)
    for agent in agents:
        if lots.random() < 0.7:
            agent.receive_message(CAPTURED, 0, message, now)


def test_agents_accept_all_forgeries_and_no_other_messages() -> None:
    local = explored().swarm.local
    dropped = set().union(*(agent.dropped for agent in local.agents.by_id.values()))
    assert dropped == {"not signed by its sender", "block not signed by its maker"}
    assert {reason for agent in local.agents.revoked.values() for reason in agent.dropped} == {"revoked sender"}
    assert any(agent.received for agent in local.agents.by_id.values())


@pytest.mark.parametrize(
    ("kind", "owner", "rule", "broken"),
    [
        ("revoked", SecuredAgent, "_drop_reason", lambda self, clear: None),
        ("name", BlockSignatures, "is_genuine", lambda self, block, signature: True),
    ],
)
def test_security_gate_without_a_rule_is_found(
    monkeypatch: pytest.MonkeyPatch, kind: str, owner: type, rule: str, broken: Any
) -> None:
    monkeypatch.setattr(owner, rule, broken)
    graph = explore(ModelSwarm(Bounds(2, 1, "lossy", captured=2)), most_bytes=8e9, most_s=600)
    assert graph.flaw is not None
    assert graph.flaw.kind == kind


def test_scenario_of_an_attack_plays_the_explored_path() -> None:
    graph, lots = explored(2, 1, 2), Random(20)
    lied = [number for number, state in enumerate(graph.states) if state[LEFT] // LIES == 0 and number]
    for number in lots.sample(lied, 12):
        document = PathScript(graph, graph.path(number)).document("a lie")
        lies = sum("lie" in entry for entry in document.get("timeline", ()))
        traces = simulate(parse(document), 1, tracing=True).evidence.traces
        forged = [
            run for trace in traces.values() for run in trace.runs if run.trigger.to_json().get("seq", 0) >= 1 << 31
        ]
        assert len(forged) == lies
        for place, local in enumerate(graph.states[number][AGENTS:]):
            if local != DEAD:
                state = graph.swarm.local.state(local)
                there = (len(state.chain), len(state.blocks_to_be_committed), len(state.reconcile_stack), state.idle)
                seen = [
                    (run.state.chain, run.state.deque, run.state.stack, run.state.idle)
                    for run in traces[place + 1].runs
                ]
                assert there in [(0, 0, 0, True), *seen]


def test_attacker_violates_only_characteristics_1_and_4(tmp_path: Path) -> None:
    proof = prove(Bounds(3, 1, "lossy", captured=CAPTURED), out=tmp_path / "captured.yaml")
    assert proof.exit_status == 1
    assert proof.flaw is None
    assert {key: {*example.judged} for key, example in proof.shown.items() if example} == {
        "1": {"1", "4"},
        "4": {"1", "4"},
    }
    bad = [line.split(",")[1].split(":")[0].strip() for line in in_words(proof) if line.startswith(("✘", "-"))]
    assert bad == ["characteristic 1", "characteristic 4"]
    assert proof.to_json()["lies"] == 1


def test_attacker_without_messages_violates_nothing(tmp_path: Path) -> None:
    assert prove(Bounds(3, 1, "lossy", captured=1, lies=0), out=tmp_path / "silent.yaml").exit_status == 0


def test_unlimited_lies_in_any_network_violate_nothing_more(tmp_path: Path) -> None:
    collected = collect(Bounds(3, 1, "any", captured=CAPTURED), most_bytes=8e9, most_s=600)
    assert (collected.ended, collected.flaw, collected.shown) == ("complete", None, {"1", "4"})


@pytest.mark.parametrize(
    "wrong",
    [{"captured": 4}, {"captured": 1, "lies": 99}, {"captured": 1, "faults": ("death",)}, {"captured": 1, "agents": 1}],
)
def test_impossible_bounds_end_with_one_sentence(wrong: dict[str, Any]) -> None:
    with pytest.raises(BoundsError):
        Bounds(**{"agents": 3, **wrong})


def test_lie_reaches_its_receivers_also_without_keys() -> None:
    lie = {"message": "Commit Block", "sender": 3, "receivers": [1], "block": "made 4.5", "chain": []}
    unheard = {"message": "Commit Block", "sender": 3, "block": "2.7", "chain": []}
    document = {
        "name": "a lie",
        "agents": 3,
        "duration_s": 60,
        "events": {"source": "scripted"},
        "timeline": [{"at_s": 5, "lie": lie}, {"at_s": 6, "lie": unheard}],
    }
    played = simulate(parse(document), 1, tracing=True)
    assert [run.branch for run in played.evidence.traces[1].runs] == ["committed"]
    assert not played.evidence.traces[2].runs
    assert len(played.played.unmatched_fates) == 1
    with pytest.raises(ScenarioError, match=r"timeline\.lie"):
        refuse_virtual_time_keys(parse(document))


def test_lie_needs_a_captured_vehicle(tmp_path: Path) -> None:
    refused = harness("prove", "--lies", 2, cwd=tmp_path)
    assert refused.returncode == 2
    assert len(sentences(refused.stderr)) == 1


def test_random_attacks_in_any_network_are_contained() -> None:
    """The agent has one block of its own, and receives any number of forged messages. Messages of other agents may come
    late, twice or never.
    """
    seen = set()

    def keep(local: LocalStates) -> None:
        for known in local.known:
            agent = Agent(known.agent_id, (1, 2, 3), b"proof", local.settings)
            put_back(agent, known.snapshot)
            seen.add(seen_of([agent]))

    assert collect(Bounds(3, 1, "any", captured=CAPTURED), most_bytes=8e9, most_s=600, keep=keep).ended == "complete"
    for seed in range(150):
        for there in lied_to_at_any_time(Random(seed)):
            assert there in seen


def lied_to_at_any_time(lots: Random) -> Iterator[Any]:
    agents = [Agent(number, (1, 2, 3), b"proof", Settings(max_block_bytes=267)) for number in (1, 2)]
    own, now, air = made_block(CAPTURED, MICROSECONDS), 0.0, []
    for _ in range(60):
        now += lots.choice([0.01, 2.5, 5.0, 10.0]) * lots.random()
        for agent in agents:
            agent.handle_timer(now)
            air += [(agent, said) for _, said in agent.messages_to_send()]
        if air and lots.random() < 0.5:
            sender, message = lots.choice(air)
            receiver = agents[sender is agents[0]]
            receiver.receive_message(sender.agent_id, 0, message, now)
        agent, other = lots.sample(agents, 2)
        material = ForgeryMaterial(
            frozenset((own,)), frozenset((own.block_hash, NOBODYS)), frozenset((asked(other.state),)), (1,)
        )
        chosen = [*forgeries(agent.state, CAPTURED, material), random_message(lots, agent, material)]
        lie = lots.choice(chosen)
        if getattr(lie, "block", own) == own:
            agent.receive_message(CAPTURED, 0, lie, now)
        yield from (seen_of([each]) for each in agents)
