"""Test the command `ucp-harness conformance`, and the results of a test in virtual time."""

import asyncio
import os
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from docs.generate.wrong_agents import quirky
from harness.conformance._state_space import VARIANTS, explore
from harness.conformance._udp_lab import AgentEndedError, NoAgentError
from harness.conformance._virtual_agent import VirtualProgram
from harness.conformance.conformance_run import ConformanceRequest, conform
from harness.conformance.results_table import to_junit
from harness.conformance.vectors import VectorSet
from tests.harness.command import DEADLINE_S, harness, processes, sentences

OURS = (sys.executable, "-P", "-m", "ucp.node")


@pytest.fixture(scope="module")
def phase_one() -> list[VectorSet]:
    steps = list(explore(VARIANTS["default"]))
    wanted = {step.key: step for step in steps if step.before.activity in ("idle", "phase one") and len(step.path) <= 3}
    assert len(wanted) > 100
    return [VectorSet(VARIANTS["default"], steps, wanted)]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "the command of the agent is missing"),
        (["--only", "21", "--", "true"], "no such Algorithm; give a number from 1 to 20"),
        (["--", "./no such agent"], "no such agent"),
        (
            ["--matrix", "agents.yaml", "--junit", "junit.xml"],
            "--matrix excludes --json, --junit, --keep",
        ),
        (["--small", "--virtual", "--", "true"], "--small excludes --virtual"),
    ],
)
def test_wrong_request_is_refused_in_one_sentence(arguments: list[str], says: str, tmp_path: Path) -> None:
    ended = harness("conformance", *arguments, cwd=tmp_path)
    assert ended.returncode == 2, ended.stderr
    assert says in sentences(ended.stderr)[-1]


@pytest.mark.lab
def test_missing_program_of_a_script_is_no_missing_feature(tmp_path: Path) -> None:
    """A shell ends with status 127 if it does not find a program. An agent without a required feature ends with the
    same status.
    """
    script = tmp_path / "agent"
    script.write_text('#!/bin/sh\nexec no-such-interpreter agent.py "$1"\n')
    script.chmod(0o755)
    ended = harness("conformance", "--only", "8", "--", script, cwd=tmp_path)
    assert ended.returncode == 2
    assert "the agent does not start" in sentences(ended.stderr)[-1]


def test_reference_agent_passes_in_virtual_time(phase_one: list[VectorSet], tmp_path: Path) -> None:
    results = conform(
        ConformanceRequest(OURS, None, None, virtual=True), tmp_path, lambda count, total: None, phase_one
    )
    document = results.to_json()
    assert sum(row["passed"] for row in document["algorithms"]) == len(phase_one[0].wanted) + 1
    assert results.exit_status == 0 and [case["verdict"] for case in document["cases"]] == ["passed"]
    assert "<testsuite " in to_junit(results)


def test_vectors_after_the_time_limit_are_not_tried(phase_one: list[VectorSet], tmp_path: Path) -> None:
    asked = ConformanceRequest(OURS, None, None, virtual=True, limit_s=0.0)
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
def test_failure_in_virtual_time_names_the_algorithm(
    quirk: str, algorithm: int, says: str, phase_one: list[VectorSet], tmp_path: Path
) -> None:
    command = (sys.executable, "-P", "-m", quirky.__name__, quirk)
    results = conform(
        ConformanceRequest(command, None, None, virtual=True), tmp_path, lambda count, total: None, phase_one
    )
    assert {case.algorithm for case in results.failures} == {algorithm}
    assert any(says in sentence for case in results.failures for sentence in case.wrong)


@pytest.mark.parametrize("command", [(sys.executable, "-c", "pass"), ("sh", "-c", "yes junk; true")])
def test_program_without_answers_is_no_agent(
    command: tuple[str, ...], phase_one: list[VectorSet], tmp_path: Path
) -> None:
    with pytest.raises(NoAgentError, match="the agent does not start"):
        conform(ConformanceRequest(command, None, None, virtual=True), tmp_path, lambda count, total: None, phase_one)


@pytest.mark.parametrize(
    "script",
    [
        'head -c 32000 /dev/zero; touch "$0"; yes',
        'exec >&-; touch "$0"; sleep 1000',
        'setsid sleep 30 & touch "$0"; sleep 1000',
    ],
    ids=["prints too much", "closes its output", "leaves a child with its pipes"],
)
def test_program_can_be_closed_with_full_or_shared_pipes(script: str, tmp_path: Path) -> None:
    ready = tmp_path / "ready"
    program = VirtualProgram(("sh", "-c", f"echo; {script}", str(ready)), tmp_path / "errors.log")
    deadline = time.monotonic() + DEADLINE_S
    while not ready.exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    program.close()


def test_cancelled_request_leaves_no_process_and_no_descriptor(tmp_path: Path) -> None:
    async def begin_and_cancel() -> None:
        program = VirtualProgram(("sh", "-c", 'cd "$0"; sleep 1000 & wait', str(tmp_path)), Path(os.devnull))
        asking = asyncio.create_task(program.ask({"t": 0.0}))
        while not processes(tmp_path):
            await asyncio.sleep(0.01)
        asking.cancel()
        await asyncio.wait([asking], timeout=10.0)
        assert asking.cancelled()
        program.close()

    before = set(Path("/proc/self/fd").iterdir())
    asyncio.run(begin_and_cancel())
    assert set(Path("/proc/self/fd").iterdir()) == before
    assert not processes(tmp_path)


def test_program_that_closes_its_standard_output_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("harness.play.simulation.foreign.line_program.END_LIMIT_S", 0.1)
    program = VirtualProgram(("sh", "-c", "exec >&-; sleep 1000"), tmp_path / "errors.log")
    with closing(program), pytest.raises(AgentEndedError, match="it closed its standard input or output and did not"):
        asyncio.run(program.ask({"t": 0.0}))
