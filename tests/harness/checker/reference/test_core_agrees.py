"""Test that the agent and the independent reference take the same steps in the same state, for random inputs.

`prove` compares them in every state within bounds. These tests instead use random inputs in random states, which may be
outside the bounds.
"""

from dataclasses import replace
from itertools import zip_longest
from random import Random
from typing import Any

import pytest

from harness.archive.vocabulary import TIMER_OF
from harness.checker.reference.reference_agent import ReferenceAgent
from harness.checker.reference.state import Settings as ReferenceSettings
from harness.checker.steps.deviation import StepDeviation
from harness.proof._proof import prove
from harness.proof.bounds import Bounds
from tests.harness.checker.reference.random_inputs import LIFE, ROSTER, Inputs
from ucp.agent import Agent
from ucp.settings import ALTERNATIVES, Settings
from ucp.store import StoredState
from ucp.trace import HandlerRun

HANDLER_OF = {timer: handler for handler, timer in TIMER_OF.items()}
INPUTS = 2_500
"""Number of random inputs for each of the 40 seeds."""


def settings_for(rng: Random) -> Settings:
    name, value = rng.choice([*ALTERNATIVES.values(), ("finalize_gap_s", 0.0), ("vote_timeout_s", 3.0)])
    changed: dict[str, Any] = {name: value}
    return replace(Settings(max_block_bytes=300), **changed)


def test_reference_has_each_setting_of_the_core_with_its_default() -> None:
    settings = Settings()
    assert vars(ReferenceSettings()) == {name: getattr(settings, name) for name in settings.__match_args__}


def runs_of(agent: Agent | ReferenceAgent) -> list[HandlerRun]:
    """Return the handler runs since the last call, without the inputs that triggered them. Only the agent records
    inputs.
    """
    return [replace(entry, input=None) for entry in agent.trace() if isinstance(entry, HandlerRun)]


def first_difference(did: list[HandlerRun], should: list[HandlerRun]) -> str | None:
    """Return a sentence about the first handler run that differs. Return None if all handler runs are equal."""
    for before, (mine, theirs) in zip([None, *did], zip_longest(did, should), strict=False):
        if mine is None or theirs is None or mine.handler != theirs.handler:
            after = f"after {before.handler} of Algorithm {before.algorithm}: " if before else ""
            return f"{after}it ran {mine and mine.handler}; it should have run {theirs and theirs.handler}"
        if mine != theirs:
            return StepDeviation(1, 0, mine.t, mine.handler, run=mine, expected=theirs).sentence(str)
    return None


def next_handler(agent: Agent) -> str:
    """Return the handler for the timer that expires next."""
    running = {timer.deadline: timer.name for timer in agent.state.timers if timer.deadline is not None}
    return HANDLER_OF[running[min(running)]] if running else "no timer"


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
        assert reference.next_timer() == core.next_timer(), (
            f"input {number}: {next_handler(core)} is due too soon or late"
        )
        now, give = inputs.draw(core, number, now)
        give(core)
        give(reference)
        did, should = runs_of(core), runs_of(reference)
        assert did == should, f"input {number}: {first_difference(did, should)}"
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
