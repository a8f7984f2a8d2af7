"""Test conformance over UDP: a correct agent passes. A wrong agent fails, and the failure names the Algorithm."""

import asyncio
import dataclasses
import sys
from pathlib import Path

import pytest

from docs.generate.wrong_agents import quirky
from harness.conformance._alphabet import INPUTS, LOG
from harness.conformance._observation import TestedStep
from harness.conformance._state_space import VARIANTS, explore
from harness.conformance._udp_agent import TIMING_IN_PARALLEL, UdpAgent
from harness.conformance._udp_lab import UdpLab
from harness.conformance.conformance_run import ConformanceRequest, conform
from harness.conformance.results import ConformanceResults
from harness.conformance.results_table import to_junit
from harness.conformance.vectors import VectorSet

pytestmark = pytest.mark.lab

OURS = (sys.executable, "-P", "-m", "ucp.node")
LIMIT_S = 60.0


@pytest.fixture(scope="module")
def idle() -> list[VectorSet]:
    """Return the generated tests of an agent that is idle with at most one block in its chain."""
    steps = list(explore(VARIANTS["default"]))
    wanted = {step.key: step for step in steps if step.before.activity == "idle" and len(step.path) <= 1}
    assert len(wanted) > 30
    return [VectorSet(VARIANTS["default"], steps, wanted)]


def results_of(vectors: list[VectorSet], place: Path, *command: str, keep: Path | None = None) -> ConformanceResults:
    place.mkdir()
    asked = ConformanceRequest(command, None, keep, handwritten=False, max_suspicions=4, limit_s=LIMIT_S)
    return conform(asked, place, lambda count, total: None, vectors)


@pytest.mark.any_user
def test_right_agent_passes_all_vectors(idle: list[VectorSet], tmp_path: Path) -> None:
    results = results_of(idle, tmp_path / "lab", *OURS)
    assert not results.failures, [case.wrong for case in results.failures]
    assert sum(row.passed for row in results.rows()) == len(idle[0].wanted)
    assert results.exit_status == 0


@pytest.mark.parametrize(
    ("quirk", "algorithm"), [("complete_and_wait", 1), ("commit_without_succession", 6), ("diverged_and_unmoved", 13)]
)
@pytest.mark.any_user
def test_failure_of_a_wrong_agent_names_its_algorithm(
    quirk: str, algorithm: int, idle: list[VectorSet], tmp_path: Path
) -> None:
    keep = tmp_path / "failures"
    results = results_of(idle, tmp_path / "lab", sys.executable, "-P", "-m", quirky.__name__, quirk, keep=keep)
    assert results.exit_status == 1
    assert {case.algorithm for case in results.failures} == {algorithm}
    first = results.failures[0]
    assert first.directory is not None
    kept = {"failure.txt", "vector.jsonl", "scenario.yaml", *(["air.pcapng"] if first.exchanges else [])}
    assert {path.name for path in Path(first.directory).iterdir()} == kept
    assert to_junit(results).count("<failure") == len(results.failures)


@pytest.mark.any_user
def test_vectors_that_need_a_missing_feature_are_not_applicable(tmp_path: Path, idle: list[VectorSet]) -> None:
    variant = dataclasses.replace(VARIANTS["default"], features=("an unknown feature",))
    results = results_of([dataclasses.replace(idle[0], variant=variant)], tmp_path / "lab", *OURS)
    assert sum(row.not_applicable for row in results.rows()) == len(idle[0].wanted)
    assert results.exit_status == 0 and "an unknown feature" in results.notes[0]


async def _steps_around_a_suspension(place: Path) -> tuple[TestedStep | None, bool, TestedStep | None]:
    """Suspend an agent until its vote should have ended. Meanwhile, give it an input. After it continues, give it
    another input.

    Return the result of the first input, whether the reference still follows the agent, and the result of the second
    input.
    """
    async with UdpLab(place, OURS, 1) as lab:
        agent = await UdpAgent.start(lab, VARIANTS["default"], TIMING_IN_PARALLEL)
        try:
            assert await agent.step(INPUTS[LOG]) is not None
            await agent.process.pause()
            resuming = asyncio.get_running_loop().create_task(_resume(agent, 0.7))
            late = await agent.step(INPUTS["Block Add Request on an unknown chain"])
            await resuming
            return late, agent.reference_follows, await agent.step(INPUTS["Chain Contain Query about the top"])
        finally:
            await agent.close()


async def _resume(agent: UdpAgent, after_s: float) -> None:
    await asyncio.sleep(after_s)
    await agent.process.resume()


def test_reference_follows_an_agent_on_a_late_machine(tmp_path: Path) -> None:
    late, reference_follows, then = asyncio.run(_steps_around_a_suspension(tmp_path))
    assert late is not None and then is not None
    assert late.late or not late.wrong
    assert reference_follows and not then.wrong, (late.wrong, then.wrong)
