"""A way as a scenario: the agent runs the same handlers there, and a wrong one is found out."""

import sys

import pytest
import yaml

from docs.generate.wrong_agents import quirky
from harness.conformance._alphabet import LOG, TIMER
from harness.conformance._kept_failures import scenario_of
from harness.conformance._reference_model import AGENT
from harness.conformance._state_space import VARIANTS
from harness.conformance._virtual_lines import Writer
from harness.run.simulate import simulate
from harness.scenario import Scenario

WAYS = [
    (LOG, LOG, TIMER, TIMER, "Chain Hash Successor Query about the inception block"),
    ("Chain Hash Successor Query about an unknown chain",),
    ("operator reconciles", "Chain Contain Response yes", TIMER),
]


def played(way: tuple[str, ...], *command: str) -> tuple[list[tuple[str, str]], list[str]]:
    """Handlers and branches of the agent under test, and what is wrong about its steps."""
    text = scenario_of("a way", (sys.executable, "-P", "-m", *command), VARIANTS["default"], way)
    simulated = simulate(Scenario.model_validate(yaml.safe_load(text)), 1, tracing=True)
    trace = simulated.evidence.traces[AGENT]
    wrong = [finding.detail for finding in simulated.result.beside["steps"].evidence]
    return [(run.handler, run.branch) for run in trace.runs], wrong


@pytest.mark.parametrize("way", WAYS)
def test_the_agent_does_there_what_it_does_under_test(way: tuple[str, ...]) -> None:
    expected = [
        (run.handler, run.branch) for line in Writer(VARIANTS["default"]).lines(way) for run in line.outcome.runs
    ]
    runs, wrong = played(way, "ucp.node")
    assert runs[: len(expected)] == expected
    assert not wrong


def test_what_is_wrong_is_found_there_too() -> None:
    _, wrong = played(WAYS[0], quirky.__name__, "name_top_as_successor")
    assert len(wrong) == 1 and "Algorithm 13" in wrong[0]
