"""Test that a proof detects each error planted into a copy of the agent, and writes a scenario that shows it."""

import json
from pathlib import Path

import pytest

from benchmarks.reductions import findings
from tests.harness.proof.edited_core import Bug, edited, with_core
from tests.harness.proof.planted_bugs import BUGS, NOT_APPROVED, PlantedBug


def bug(name: str) -> PlantedBug:
    return next(each for each in BUGS if each.name == name)


@pytest.mark.parametrize(
    ("name", "blocks", "options", "kind", "played"),
    [
        ("agent 2 ignores commits of agent 1", 2, (), None, "liveness"),
        ("a block is lost after two refusals", 3, ("--losses", 1), "2", "2"),
        ("a tally of votes is not cleared", 2, ("--steps",), "steps", "steps"),
        ("a reconcile never ends", 2, (), "hang", "liveness"),
        ("a tie of phase 1 crashes", 3, ("--network", "lossless", "--agents", 3), "crash", "steps"),
    ],
)
def test_planted_bug_is_found_and_its_scenario_plays_it(
    name: str, blocks: int, options: tuple[object, ...], kind: str | None, played: str, tmp_path: Path
) -> None:
    core = edited(tmp_path, *bug(name).edits)
    arguments = ("prove", "--agents", 2, "--blocks", blocks, *options, "--out", "found.yaml", "--cores", 1)
    found = with_core(core, *arguments, "--json", cwd=tmp_path)
    assert found.returncode == 1, found.stderr
    document = json.loads(found.stdout)
    assert document["reduced"] is False
    assert (document["flaw"] and document["flaw"]["kind"]) == kind
    assert played in document["example"]["judged"]
    again = with_core(core, "run", "found.yaml", "--backend", "sim", "--seed", 1, "--out", "run", cwd=tmp_path)
    assert again.returncode == 1, again.stderr


@pytest.mark.parametrize(
    ("name", "forced"),
    [
        ("agent 1 is refused by its ID", []),
        ("a tally of votes is not cleared", []),
        ("a block is lost after two refusals", ["refused"]),
    ],
)
def test_bug_is_found_as_without_reductions(name: str, forced: list[str]) -> None:
    """The prover uses no reductions here. With reductions, it would miss the bug or refuse the agent."""
    expected = [*bug(name).findings]
    assert findings(bug(name)) == {"default": expected, "whole": expected, "forced": forced}


def test_violation_after_further_votes_is_a_printed_reason(tmp_path: Path) -> None:
    """No agent within the bounds has a chain of two blocks when it votes. A further vote would show the deviation."""
    right = "approve = message.chain_hash == core.chain.top_chain_hash"
    core = edited(tmp_path, Bug("commit.py", right, f"{right} and len(core.chain) < 2"))
    done = with_core(core, "prove", "--agents", 2, "--blocks", 2, "--network", "lossless", "--steps", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    assert "✘ not shown, one chain" in done.stdout
    assert "after further votes a violation ended a path: Algorithm 3, receive_request_add_block" in done.stdout
    assert "played: a run cannot show that no path leads to one chain" in done.stdout


def test_agent_that_depends_on_a_counter_is_refused(tmp_path: Path) -> None:
    """The number of reconciles grows without limit, so it cannot be part of a state."""
    wrong = NOT_APPROVED.replace(
        "        core", "        if core.reconciles == 2:\n            core.take_from_deque()\n        core"
    )
    core = edited(tmp_path, Bug("commit.py", NOT_APPROVED, wrong))
    done = with_core(core, "prove", "--agents", 2, "--blocks", 2, cwd=tmp_path)
    assert done.returncode == 2
    assert "or on a counter (reconciles" in done.stderr
    assert "Traceback" not in done.stderr


def test_agent_that_depends_on_the_mission_time_is_refused(tmp_path: Path) -> None:
    """A state of the proof contains the remaining times of timers, but not the mission time."""
    late = Bug("commit.py", NOT_APPROVED, NOT_APPROVED.replace("not approved", "not approved and core.now < 60"))
    done = with_core(edited(tmp_path, late), "prove", "--agents", 2, "--blocks", 2, cwd=tmp_path)
    assert done.returncode == 2
    assert "depends on the mission time" in done.stderr
