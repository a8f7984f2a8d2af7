"""Test that a proof detects each error planted into a copy of the agent, and writes a scenario that shows it."""

import json
from pathlib import Path

import pytest

from tests.harness.proof.edited_core import Bug, edited, with_core

NOT_APPROVED = 'if not approved:\n        core.trigger("Reconcile Begin")'
BY_ID = Bug(
    "commit.py",
    "    if core.holds(message.block.block_hash):",
    '    if core.agent_id == 2 and sender == 1:\n        return "does not succeed"\n'
    "    if core.holds(message.block.block_hash):",
)
REFUSES_BY_ID = Bug(
    "commit.py",
    "approve = message.chain_hash == core.chain.top_chain_hash",
    "approve = message.chain_hash == core.chain.top_chain_hash and sender != 1",
)
LOSES_AFTER_TWO = Bug(
    "commit.py",
    NOT_APPROVED,
    "if not approved:\n        core.refused = getattr(core, 'refused', 0) + 1\n"
    "        if core.refused == 2:\n            core.take_from_deque()\n"
    '        core.trigger("Reconcile Begin")',
)
KEEPS_TALLY = Bug("commit.py", 'core.vote_count = {"yes": 1, "no": 0}', 'core.vote_count["yes"] += 1')
RESTS_WITH_DEQUE = Bug(
    "commit.py",
    'core.trigger("Process Next Deque Block")\n        return "chain changed"',
    'return "chain changed"',
)
DROPS_FRONT = Bug(
    "commit.py",
    'core.commit(message.block)\n    return "committed"',
    "core.commit(message.block)\n    if core.voting_timer.active and core.agent_id < sender:\n"
    '        core.take_from_deque()\n        core.voting_timer.stop()\n    return "committed"',
)
KEEPS_FLAG = Bug(
    "reconcile.py",
    "    core.reconcile_in_progress = False\n",
    "    core.reconcile_in_progress = bool(core.blocks_to_be_committed)\n",
)
CRASHES = Bug(
    "reconcile.py",
    'yes, no = core.reconcile_vote_count["yes"], core.reconcile_vote_count["no"]',
    'yes, no = core.reconcile_vote_count["yes"], core.reconcile_vote_count["no"]\n    assert yes != no or not yes',
)


@pytest.mark.parametrize(
    ("bug", "blocks", "options", "kind", "played"),
    [
        pytest.param(BY_ID, 2, (), None, "liveness", id="agent 2 ignores commits of agent 1"),
        pytest.param(REFUSES_BY_ID, 2, (), None, "liveness", id="agent 1 is refused by its ID"),
        pytest.param(LOSES_AFTER_TWO, 3, ("--losses", 1), "2", "2", id="a block is lost after two refusals"),
        pytest.param(KEEPS_TALLY, 2, ("--steps",), "steps", "steps", id="a tally of votes is not cleared"),
        pytest.param(RESTS_WITH_DEQUE, 2, (), "2", "2", id="an agent rests with a block in its deque"),
        pytest.param(DROPS_FRONT, 2, (), "2", "2", id="a commit that crosses a vote drops the block"),
        pytest.param(KEEPS_FLAG, 2, (), "hang", "liveness", id="a reconcile never ends"),
        pytest.param(CRASHES, 3, ("--network", "lossless", "--agents", 3), "crash", "steps", id="a tie crashes"),
    ],
)
def test_planted_bug_is_found_and_its_scenario_plays_it(
    bug: Bug, blocks: int, options: tuple[object, ...], kind: str | None, played: str, tmp_path: Path
) -> None:
    core = edited(tmp_path, bug)
    arguments = ("prove", "--agents", 2, "--blocks", blocks, *options, "--out", "found.yaml", "--cores", 1)
    found = with_core(core, *arguments, "--json", cwd=tmp_path)
    assert found.returncode == 1, found.stderr
    document = json.loads(found.stdout)
    assert document["reduced"] is False
    assert (document["flaw"] and document["flaw"]["kind"]) == kind
    assert played in document["example"]["judged"]
    again = with_core(core, "run", "found.yaml", "--backend", "sim", "--seed", 1, "--out", "run", cwd=tmp_path)
    assert again.returncode == 1, again.stderr


def test_agent_that_depends_on_a_counter_is_refused(tmp_path: Path) -> None:
    """The number of reconciles grows without limit, so it cannot be part of a state."""
    wrong = NOT_APPROVED.replace(
        "        core", "        if core.reconciles == 2:\n            core.take_from_deque()\n        core"
    )
    core = edited(tmp_path, Bug("commit.py", NOT_APPROVED, wrong))
    done = with_core(core, "prove", "--agents", 2, "--blocks", 2, cwd=tmp_path)
    assert done.returncode == 2
    assert "depends on the mission time, or on how often it has done something before (reconciles" in done.stderr
    assert "Traceback" not in done.stderr


def test_agent_that_depends_on_the_mission_time_is_refused(tmp_path: Path) -> None:
    """A state of the proof has the remaining times of timers, and not the time of the mission."""
    late = Bug("commit.py", NOT_APPROVED, NOT_APPROVED.replace("not approved", "not approved and core.now < 60"))
    done = with_core(edited(tmp_path, late), "prove", "--agents", 2, "--blocks", 2, cwd=tmp_path)
    assert done.returncode == 2
    assert "depends on the mission time, or on how often" in done.stderr
