"""The agent core and the independent reference do the same in the same state, whatever the input.

`prove` compares them in every state within bounds. Here both get random inputs in random states beyond all bounds.
"""

from dataclasses import replace
from random import Random
from typing import Any

import pytest

from harness.checker.reference.reference_agent import ReferenceAgent
from harness.checker.reference.state import Settings as ReferenceSettings
from harness.proof._proof import prove
from harness.proof.bounds import Bounds
from ucp.agent import Agent
from ucp.block import Block, next_chain_hash
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
from ucp.settings import ALTERNATIVES, Settings
from ucp.store import StoredState
from ucp.trace import HandlerRun

ROSTER = range(1, 6)
INPUTS = 2_500
"""Random inputs for each of 40 seeds."""
LIFE = 250
"""Inputs until the agent reboots with its store, or starts again with another agent's settings."""


class Inputs:
    """Draws inputs that fit the state of an agent, nearly fit it, or do not fit it at all."""

    def __init__(self, rng: Random) -> None:
        self.rng = rng
        self.blocks = [Block(rng.choice(ROSTER), rng.randrange(1_000), rng.randbytes(4)) for _ in range(12)]
        self.heard: list[Message] = []

    def message(self, agent: Agent) -> Message:
        rng, state = self.rng, agent.state
        if self.heard and rng.random() < 0.1:
            return rng.choice(self.heard)
        held = [*state.chain, *state.blocks_to_be_committed, *state.reconcile_stack]
        block = rng.choice(held if held and rng.random() < 0.5 else self.blocks)
        top = state.chain.top_chain_hash
        below = [state.chain.inception.chain_hash, *(chain_hash for _, chain_hash in state.chain.with_chain_hashes())]
        chain_hash = rng.choice((top, top, rng.choice(below), rng.choice(self.blocks).block_hash))
        asked = state.majority_response_block_hash
        wanted = next((each for each in (*held, *self.blocks) if each.block_hash == asked), block)
        candidate = state.candidate_block.block_hash if state.candidate_block else block.block_hash
        named = rng.choice((None, state.top_chain_hash_at_initiation, chain_hash))
        yes = rng.random() < 0.5
        message: Message = rng.choice(
            (
                BlockAddRequest(block.block_hash, chain_hash),
                BlockAddResponse(rng.choice((candidate, block.block_hash)), yes, named or None),
                CommitBlock(block, next_chain_hash(chain_hash, block.block_hash)),
                ChainContainQuery(chain_hash),
                ChainContainResponse(chain_hash, yes),
                ChainHashSuccessorQuery(chain_hash),
                NextInSequenceResponse(chain_hash, block.block_hash if yes else None, block.timestamp_us),
                RequestForBlock(block.block_hash),
                BlockResponse(rng.choice((wanted, block))),
            )
        )
        self.heard.append(message)
        return message

    def event(self) -> LoggableEvent:
        rng = self.rng
        return LoggableEvent(rng.randrange(1_000), rng.randint(1, 254), bytes(rng.choice((0, 40, 256))))


def settings_for(rng: Random) -> Settings:
    name, value = rng.choice([*ALTERNATIVES.values(), ("finalize_gap_s", 0.0), ("vote_timeout_s", 3.0)])
    changed: dict[str, Any] = {name: value}
    return replace(Settings(max_block_bytes=300), **changed)


def test_reference_has_each_setting_of_the_core_with_its_default() -> None:
    settings = Settings()
    assert vars(ReferenceSettings()) == {name: getattr(settings, name) for name in settings.__match_args__}


def runs_of(agent: Agent | ReferenceAgent) -> list[HandlerRun]:
    """Return the handler runs since the last call without the inputs, which only the core records."""
    return [replace(entry, input=None) for entry in agent.trace() if isinstance(entry, HandlerRun)]


@pytest.mark.parametrize("seed", range(40))
def test_core_and_reference_agree_on_random_inputs_in_random_states(seed: int) -> None:
    rng = Random(seed)
    inputs, now, steps = Inputs(rng), 0.0, 0
    stored: StoredState | None = None
    settings = settings_for(rng)
    for number in range(INPUTS):
        if number % LIFE == 0:
            core = Agent(1, ROSTER, b"mission", settings)
            reference = ReferenceAgent(1, ROSTER, b"mission", ReferenceSettings.of(settings))
            if stored is not None:
                core.boot(stored, now)
                reference.boot(stored, now)
        draw, ends = rng.random(), core.next_timer()
        assert reference.next_timer() == ends
        if draw < 0.08 and ends is not None:
            now = max(now, ends)
            core.handle_timer(now)
            reference.handle_timer(now)
        elif draw < 0.12:
            event = inputs.event()
            core.add_event(event, now)
            reference.add_event(event, now)
        elif draw < 0.13:
            core.begin_reconcile(now)
            reference.begin_reconcile(now)
        else:
            sender, message = rng.choice(ROSTER), inputs.message(core)
            core.receive_message(sender, number, message, now)
            reference.receive_message(sender, number, message, now)
        did, should = runs_of(core), runs_of(reference)
        assert did == should, f"input {number}"
        steps += len(did)
        assert core.messages_to_send() == reference.messages_to_send()
        stored = StoredState.of(core.state)
        now += rng.choice((0.0, 0.01, 0.4))
    assert steps > INPUTS / 2


@pytest.mark.parametrize(
    "bounds",
    [
        Bounds(2, 3, "lossy", ("reboot",), steps=True),
        Bounds(3, 2, "lossy", steps=True),
        Bounds(3, 3, "lossless", steps=True),
        Bounds(2, 2, "any", steps=True),
        *(Bounds(3, 2, "lossy", steps=True, settings={name: value}) for name, value in ALTERNATIVES.values()),
    ],
    ids=str,
)
def test_core_and_reference_agree_in_every_state_within_bounds(bounds: Bounds) -> None:
    proof = prove(bounds)
    assert proof.flaw is None or proof.flaw.kind != "steps", proof.flaw
