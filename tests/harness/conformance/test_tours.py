"""Test how the conformance test plays many generated tests in sequence, including tests for which the machine was too
late.

Test conformance inputs as a scenario: the agent runs the same handlers, and the checker detects a wrong agent.
"""

import asyncio
import sys
import time

import pytest
import yaml

from docs.generate.wrong_agents import quirky
from harness.conformance._agent_under_test import AgentUnderTest
from harness.conformance._alphabet import LOG, TIMER, AgentInput
from harness.conformance._observation import RecordedDatagram, TestedStep
from harness.conformance._reference_model import AGENT
from harness.conformance._state_space import VARIANTS, SettingsVariant, advance, explore, key_of, state_of
from harness.conformance._suite import VectorSuite
from harness.conformance._tours import VectorMap
from harness.conformance._virtual_agent import LineWriter
from harness.conformance.conformance_run import scenario_of
from harness.conformance.vectors import VectorSet
from harness.run.simulate import simulate
from harness.scenario import Scenario


def test_impossible_vector_is_not_tried_again_in_the_same_state() -> None:
    """A vote is impossible if all other agents have voted. The conformance test then continues with the next tests."""
    variant = VARIANTS["default"]
    steps = list(explore(variant))
    wanted = next(step for step in steps if step.key.input == "vote no" and not step.key.counted)
    vector_map = VectorMap(variant, steps, {wanted.key})
    assert vector_map.unseen_in(wanted.before) == wanted.key
    assert vector_map.path_from(wanted.before) == (["vote no"], wanted.key)
    assert vector_map.unseen_in(wanted.before, {wanted.key}) is None
    assert vector_map.path_from(wanted.before, {wanted.key}) is None


class AgentOnLateMachine(AgentUnderTest):
    """A correct agent on a machine that is always late, except while the agent runs alone."""

    def __init__(self, variant: SettingsVariant, alone: bool) -> None:
        super().__init__(variant)
        self._alone = alone
        self._now = 0.0

    async def _step(self, given: AgentInput) -> TestedStep | None:
        before = state_of(self.model)
        advanced = advance(self.model, given, self._now)
        if advanced is None:
            return None
        outcome, self._now = advanced
        wrong = () if self._alone else ("it did not send an expected message",)
        return TestedStep(key_of(before, given), outcome, given.name, (), (), wrong, before, late=not self._alone)

    @property
    def timer_is_near(self) -> bool:
        return False

    def exchanges(self) -> tuple[RecordedDatagram, ...]:
        return ()

    async def close(self) -> None:
        """Do nothing, because nothing is open."""


def test_vectors_on_a_late_machine_are_tried_alone_at_the_end() -> None:
    variant = VARIANTS["default"]
    steps = list(explore(variant))
    wanted = {step.key: step for step in steps if step.before.activity == "idle" and not step.path}

    async def start(variant: SettingsVariant, alone: bool) -> AgentUnderTest:
        return AgentOnLateMachine(variant, alone)

    for seconds, passed in ((60.0, len(wanted)), (-1.0, 0)):
        suite = VectorSuite(start, [VectorSet(variant, steps, wanted)], lambda count: None, workers=3)
        asyncio.run(suite.run(time.monotonic() + seconds))
        assert [len(variant_result.passed) for variant_result in suite.variant_results] == [passed]
        assert not suite.variant_results[0].failures


PATHS = [
    (LOG, LOG, TIMER, TIMER, "Chain Hash Successor Query about the inception block"),
    ("Chain Hash Successor Query about an unknown chain",),
    ("operator reconciles", "Chain Contain Response yes", TIMER),
]


def played(path: tuple[str, ...], *command: str) -> tuple[list[tuple[str, str]], list[str]]:
    """Play inputs as a scenario. Return the handlers and branches of the agent under test, and its deviations."""
    text = scenario_of("a path", (sys.executable, "-P", "-m", *command), VARIANTS["default"], path)
    simulated = simulate(Scenario.model_validate(yaml.safe_load(text)), 1, tracing=True)
    trace = simulated.evidence.traces[AGENT]
    wrong = [finding.detail for finding in simulated.result.beside["steps"].evidence]
    return [(run.handler, run.branch) for run in trace.runs], wrong


@pytest.mark.parametrize("path", PATHS)
def test_agent_runs_the_same_handlers_in_the_scenario(path: tuple[str, ...]) -> None:
    expected = [
        (run.handler, run.branch) for line in LineWriter(VARIANTS["default"]).lines(path) for run in line.outcome.runs
    ]
    runs, wrong = played(path, "ucp.node")
    assert runs[: len(expected)] == expected
    assert not wrong


def test_checker_finds_the_wrong_agent_in_the_scenario() -> None:
    _, wrong = played(PATHS[0], quirky.__name__, "name_top_as_successor")
    assert len(wrong) == 1 and "Algorithm 13" in wrong[0]
