"""Test conformance inputs as a scenario: the agent runs the same handlers, and the checker detects a wrong agent."""

import sys

import pytest
import yaml

from docs.generate.wrong_agents import quirky
from harness.conformance._alphabet import LOG, TIMER
from harness.conformance._kept_failures import scenario_of
from harness.conformance._reference_model import AGENT
from harness.conformance._state_space import VARIANTS
from harness.conformance._virtual_lines import LineWriter
from harness.run.simulate import simulate
from harness.scenario import Scenario

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
