"""Over UDP: a right agent passes; wrong ones fail, and the right Algorithm is named."""

import asyncio
import dataclasses
import sys
from pathlib import Path

import pytest

from docs.generate.wrong_agents import quirky
from harness.conformance._alphabet import INPUTS, LOG
from harness.conformance._observation import Seen
from harness.conformance._state_space import VARIANTS, explore
from harness.conformance._udp_lab import Air
from harness.conformance._udp_subject import BESIDE_OTHERS, OverUdp
from harness.conformance.conformance_run import Asked, conform
from harness.conformance.results import Results
from harness.conformance.results_table import to_junit
from harness.conformance.vectors import Vectors

pytestmark = pytest.mark.lab

OURS = (sys.executable, "-P", "-m", "ucp.node")
LIMIT_S = 60.0


@pytest.fixture(scope="module")
def idle() -> list[Vectors]:
    """What an agent does that is idle, with up to one block in its chain."""
    steps = list(explore(VARIANTS["default"]))
    wanted = {step.pair: step for step in steps if step.before.doing == "idle" and len(step.way) <= 1}
    assert len(wanted) > 30
    return [Vectors(VARIANTS["default"], steps, wanted)]


def results_of(vectors: list[Vectors], place: Path, *command: str, keep: Path | None = None) -> Results:
    place.mkdir()
    asked = Asked(command, None, keep, by_hand=False, enough=4, limit_s=LIMIT_S)
    return conform(asked, place, lambda count, total: None, vectors)


def test_a_right_agent_passes_all(idle: list[Vectors], tmp_path: Path) -> None:
    results = results_of(idle, tmp_path / "lab", *OURS)
    assert not results.failures, [case.wrong for case in results.failures]
    assert sum(row.passed for row in results.rows()) == len(idle[0].wanted)
    assert results.exit_status == 0


@pytest.mark.parametrize(
    ("quirk", "algorithm"), [("complete_and_wait", 1), ("commit_without_succession", 6), ("diverged_and_unmoved", 13)]
)
@pytest.mark.any_user
def test_of_a_wrong_agent_the_algorithm_is_named(
    quirk: str, algorithm: int, idle: list[Vectors], tmp_path: Path
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
def test_an_agent_that_lacks_what_the_settings_need_is_not_applicable(tmp_path: Path, idle: list[Vectors]) -> None:
    variant = dataclasses.replace(VARIANTS["default"], features=("a feature that nobody has",))
    results = results_of([dataclasses.replace(idle[0], variant=variant)], tmp_path / "lab", *OURS)
    assert sum(row.not_applicable for row in results.rows()) == len(idle[0].wanted)
    assert results.exit_status == 0 and "a feature that nobody has" in results.notes[0]


async def _late(place: Path) -> tuple[Seen | None, bool, Seen | None]:
    """What is seen of an agent that is stopped while its vote ends; whether it is still followed; what comes then."""
    async with Air(place, OURS, 1) as air:
        subject = await OverUdp.start(air, VARIANTS["default"], BESIDE_OTHERS)
        try:
            assert await subject.step(INPUTS[LOG]) is not None
            await subject.process.pause()
            resuming = asyncio.get_running_loop().create_task(_resume(subject, 0.7))
            late = await subject.step(INPUTS["Block Add Request on an unknown chain"])
            await resuming
            return late, subject.in_step, await subject.step(INPUTS["Chain Contain Query about the top"])
        finally:
            await subject.close()


async def _resume(subject: OverUdp, after_s: float) -> None:
    await asyncio.sleep(after_s)
    await subject.process.resume()


def test_of_a_late_machine_nothing_is_said_and_the_agent_is_followed(tmp_path: Path) -> None:
    late, in_step, then = asyncio.run(_late(tmp_path))
    assert late is not None and then is not None
    assert late.late or not late.wrong
    assert in_step and not then.wrong, (late.wrong, then.wrong)
