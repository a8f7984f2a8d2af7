"""`ucp-harness conformance`, as a user gives it; and what is made of its results."""

import asyncio
import os
import sys
import time
from pathlib import Path

import pytest

from docs.generate.wrong_agents import quirky
from harness.conformance._state_space import VARIANTS, explore
from harness.conformance._udp_lab import AgentEndedError, NoAgentError
from harness.conformance._virtual_subject import Program
from harness.conformance.conformance_run import Asked, conform
from harness.conformance.results_table import to_junit
from harness.conformance.vectors import Vectors
from tests.harness.command import harness, processes, sentences

OURS = (sys.executable, "-P", "-m", "ucp.node")


@pytest.fixture(scope="module")
def phase_one() -> list[Vectors]:
    steps = list(explore(VARIANTS["default"]))
    wanted = {step.pair: step for step in steps if step.before.doing in ("idle", "phase one") and len(step.way) <= 3}
    assert len(wanted) > 100
    return [Vectors(VARIANTS["default"], steps, wanted)]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "the command of the agent is missing"),
        (["--only", "21", "--", "true"], "no such Algorithm; give a number from 1 to 20"),
        (["--", "./no such agent"], "no such agent"),
    ],
)
def test_a_wrong_request_is_said_in_a_sentence(arguments: list[str], says: str, tmp_path: Path) -> None:
    ended = harness("conformance", *arguments, cwd=tmp_path)
    assert ended.returncode == 2, ended.stderr
    assert says in sentences(ended.stderr)[-1]


def test_in_virtual_time_ours_passes(phase_one: list[Vectors], tmp_path: Path) -> None:
    results = conform(Asked(OURS, None, None, virtual=True), tmp_path, lambda count, total: None, phase_one)
    told = results.to_json()
    assert sum(row["passed"] for row in told["algorithms"]) == len(phase_one[0].wanted)
    assert results.exit_status == 0 and not told["cases"]
    assert "<testsuite " in to_junit(results)


def test_what_was_not_tried_has_not_passed(phase_one: list[Vectors], tmp_path: Path) -> None:
    asked = Asked(OURS, None, None, virtual=True, limit_s=0.0)
    results = conform(asked, tmp_path, lambda count, total: None, phase_one)
    assert results.not_tried and not results.failures and results.exit_status == 3
    assert "vectors not tried" in to_junit(results)


@pytest.mark.parametrize(
    ("quirk", "algorithm", "says"),
    [
        ("hasty_phase1", 8, "its next timer expires at"),
        ("never_ask_phase2", 12, "it did not send Chain Hash Successor Query"),
        ("skip_phase2", 11, "it did not send Chain Hash Successor Query"),
        ("lose_popped_block", 11, "its status says stack 0, not 1"),
    ],
)
def test_in_virtual_time_the_algorithm_is_named(
    quirk: str, algorithm: int, says: str, phase_one: list[Vectors], tmp_path: Path
) -> None:
    command = (sys.executable, "-P", "-m", quirky.__name__, quirk)
    results = conform(Asked(command, None, None, virtual=True), tmp_path, lambda count, total: None, phase_one)
    assert {case.algorithm for case in results.failures} == {algorithm}
    assert any(says in sentence for case in results.failures for sentence in case.wrong)


@pytest.mark.parametrize("command", [(sys.executable, "-c", "pass"), ("sh", "-c", "yes junk; true")])
def test_a_program_that_does_not_answer_is_no_agent(
    command: tuple[str, ...], phase_one: list[Vectors], tmp_path: Path
) -> None:
    with pytest.raises(NoAgentError, match="the agent does not start"):
        conform(Asked(command, None, None, virtual=True), tmp_path, lambda count, total: None, phase_one)


@pytest.mark.parametrize(
    "script",
    ["yes", "exec >&-; sleep 1000", "setsid sleep 30 & sleep 1000"],
    ids=["says too much", "says nothing more", "leaves somebody with its pipes"],
)
def test_whatever_a_program_does_with_its_pipes_it_can_be_closed(script: str, tmp_path: Path) -> None:
    async def end() -> None:
        program = await Program.start(("sh", "-c", f"echo; {script}"), tmp_path / "errors.log")
        await asyncio.sleep(1.0)  # so much is said meanwhile that nobody takes it
        await asyncio.wait_for(program.close(), 10.0)

    asyncio.run(end())


def test_where_its_start_is_cancelled_nothing_of_it_is_left(tmp_path: Path) -> None:
    async def begin_and_cancel(steps: int) -> bool:
        script = 'cd "$0"; sleep 1000 & wait'
        starting = asyncio.create_task(Program.start(("sh", "-c", script, str(tmp_path)), Path(os.devnull)))
        for _ in range(steps):
            await asyncio.sleep(0)
        too_late = starting.done()
        starting.cancel()
        await asyncio.wait([starting], timeout=10.0)
        assert starting.done(), f"cancelled after {steps} steps it goes on for ever"
        if too_late:
            await starting.result().close()
        return too_late

    before = set(Path("/proc/self/fd").iterdir())
    assert any(asyncio.run(begin_and_cancel(steps)) for steps in range(20)), "it was never let start"
    assert set(Path("/proc/self/fd").iterdir()) == before
    until = time.monotonic() + 10.0
    while left := processes(tmp_path):
        assert time.monotonic() < until, left
        time.sleep(0.01)


def test_a_program_that_closes_its_standard_output_and_goes_on_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("harness.conformance._virtual_subject.GRACE_S", 0.1)

    async def ask() -> None:
        program = await Program.start(("sh", "-c", "exec >&-; sleep 1000"), tmp_path / "errors.log")
        try:
            with pytest.raises(AgentEndedError, match="closed its standard output and still runs"):
                await program.ask({"t": 0.0})
        finally:
            await program.close()

    asyncio.run(ask())
