"""List bugs for copies of the agent core, and the smallest bounds within which `prove` finds each bug.

Most bugs break an assumption of a state reduction. These assumptions are that IDs make no difference, that no agent
reads a tally whose timer does not run, that the order of answers makes no difference, and that no block disappears.
"""

from typing import NamedTuple

from harness.proof import Bounds
from tests.harness.proof.edited_core import Bug


class PlantedBug(NamedTuple):
    """A bug as edits of `ucp/`, the bounds within which the prover finds the bug, and the kinds of the findings.

    The kind "refused" means that the prover refuses the agent, because the agent's steps depend on data that are not
    part of a state.
    """

    name: str
    edits: tuple[Bug, ...]
    bounds: Bounds
    findings: tuple[str, ...]


NOT_APPROVED = 'if not approved:\n        core.trigger("Reconcile Begin")'
BUGS = (
    PlantedBug(
        "agent 2 ignores commits of agent 1",
        (
            Bug(
                "commit.py",
                "    if core.holds(message.block.block_hash):",
                '    if core.agent_id == 2 and sender == 1:\n        return "does not succeed"\n'
                "    if core.holds(message.block.block_hash):",
            ),
        ),
        Bounds(2, 2, "lossless"),
        ("livelock", "one chain"),
    ),
    PlantedBug(
        "agent 1 is refused by its ID",
        (
            Bug(
                "commit.py",
                "approve = message.chain_hash == core.chain.top_chain_hash",
                "approve = message.chain_hash == core.chain.top_chain_hash and sender != 1",
            ),
        ),
        Bounds(2, 1),
        ("livelock", "one chain"),
    ),
    PlantedBug(
        "an agent that votes refuses a lower ID",
        (
            Bug(
                "commit.py",
                "approve = message.chain_hash == core.chain.top_chain_hash",
                "approve = message.chain_hash == core.chain.top_chain_hash\n"
                "    approve = approve and not (core.voting_timer.active and sender < core.agent_id)",
            ),
        ),
        Bounds(2, 2, "lossless", steps=True),
        ("steps",),
    ),
    PlantedBug(
        "a block is lost after two refusals",
        (
            Bug(
                "commit.py",
                NOT_APPROVED,
                "if not approved:\n        core.refused = getattr(core, 'refused', 0) + 1\n"
                "        if core.refused == 2:\n            core.take_from_deque()\n"
                '        core.trigger("Reconcile Begin")',
            ),
        ),
        Bounds(2, 2),
        ("2",),
    ),
    PlantedBug(
        "a tally of votes is not cleared",
        (Bug("commit.py", 'core.vote_count = {"yes": 1, "no": 0}', 'core.vote_count["yes"] += 1'),),
        Bounds(2, 2, "lossless"),
        ("one chain",),
    ),
    PlantedBug(
        "the voters are not cleared",
        (Bug("commit.py", "    core.voters.clear()\n", ""),),
        Bounds(2, 2, "lossless"),
        ("one chain",),
    ),
    PlantedBug(
        "an approval needs an answer",
        (Bug("commit.py", '> core.vote_count["no"]', '> max(1, core.vote_count["no"])'),),
        Bounds(1, 1),
        ("livelock", "one chain"),
    ),
    PlantedBug(
        "the proposed chain of a running vote is approved",
        (
            Bug(
                "commit.py",
                "approve = message.chain_hash == core.chain.top_chain_hash",
                "approve = message.chain_hash == core.chain.top_chain_hash\n"
                "    approve = approve or (\n"
                "        core.voting_timer.active and message.chain_hash == core.top_chain_hash_at_initiation\n    )",
            ),
        ),
        Bounds(3, 3, "lossless", steps=True),
        ("steps",),
    ),
    PlantedBug(
        "an agent that has proposed a block ignores commits",
        (
            Bug(
                "commit.py",
                "    if core.holds(message.block.block_hash):",
                "    if core.candidate_block is not None and not core.voting_timer.active:\n"
                '        return "does not succeed"\n    if core.holds(message.block.block_hash):',
            ),
        ),
        Bounds(2, 2, "lossless"),
        ("one chain",),
    ),
    PlantedBug(
        "an agent is idle with a block in its deque",
        (
            Bug(
                "commit.py",
                'core.trigger("Process Next Deque Block")\n        return "chain changed"',
                'return "chain changed"',
            ),
        ),
        Bounds(2, 2, "lossless"),
        ("2",),
    ),
    PlantedBug(
        "a commit that crosses a vote drops the block",
        (
            Bug(
                "commit.py",
                'core.commit(message.block)\n    return "committed"',
                "core.commit(message.block)\n    if core.voting_timer.active and core.agent_id < sender:\n"
                '        core.take_from_deque()\n        core.voting_timer.stop()\n    return "committed"',
            ),
        ),
        Bounds(2, 2, "lossless"),
        ("2",),
    ),
    PlantedBug(
        "a commit that crosses a vote starts the vote again",
        (
            Bug(
                "commit.py",
                '"held already", "committed")',
                '"held already", "committed", triggers=("Process Next Deque Block",))',
            ),
            Bug(
                "commit.py",
                'core.commit(message.block)\n    return "committed"',
                "core.commit(message.block)\n    if core.voting_timer.active:\n        core.voting_timer.stop()\n"
                '        core.trigger("Process Next Deque Block")\n    return "committed"',
            ),
        ),
        Bounds(2, 2, "lossless", steps=True),
        ("steps",),
    ),
    PlantedBug(
        "no block is proposed after a reconcile",
        (
            Bug(
                "reconcile.py",
                'core.reconcile_in_progress = False\n    core.trigger("Process Next Deque Block")',
                "core.reconcile_in_progress = False",
            ),
        ),
        Bounds(2, 2, "lossless"),
        ("2",),
    ),
    PlantedBug(
        "a reconcile never ends",
        (
            Bug(
                "reconcile.py",
                "    core.reconcile_in_progress = False\n",
                "    core.reconcile_in_progress = bool(core.blocks_to_be_committed)\n",
            ),
        ),
        Bounds(2, 1),
        ("one chain",),
    ),
    PlantedBug(
        "answers of phase 1 add up",
        (
            Bug(
                "reconcile.py",
                'core.reconcile_vote_count = {"yes": 0, "no": 0}\n    core.reconcile_responders',
                "core.reconcile_responders",
            ),
        ),
        Bounds(2, 2, steps=True),
        ("steps",),
    ),
    PlantedBug(
        "the last answer of phase 1 decides",
        (
            Bug(
                "reconcile.py",
                "core.reconcile_vote_count[vote] += 1",
                'core.reconcile_vote_count = {"yes": 0, "no": 0, vote: 1}',
            ),
        ),
        Bounds(3, 2, "lossless", steps=True),
        ("steps",),
    ),
    PlantedBug(
        "a tie of phase 1 crashes",
        (
            Bug(
                "reconcile.py",
                'yes, no = core.reconcile_vote_count["yes"], core.reconcile_vote_count["no"]',
                'yes, no = core.reconcile_vote_count["yes"], core.reconcile_vote_count["no"]\n'
                "    assert yes != no or not yes",
            ),
        ),
        Bounds(3, 3, "lossless"),
        ("crash",),
    ),
    PlantedBug(
        "who answered phase 1 does not count in phase 2",
        (
            Bug(
                "reconcile.py",
                "core.reconcile_response_dictionary.clear()\n    core.reconcile_responders.clear()",
                "core.reconcile_response_dictionary.clear()",
            ),
        ),
        Bounds(2, 2, "lossless"),
        ("one chain",),
    ),
    PlantedBug(
        "candidates of phase 2 add up",
        (Bug("reconcile.py", "    core.reconcile_response_dictionary.clear()\n", ""),),
        Bounds(2, 2, steps=True),
        ("steps",),
    ),
    PlantedBug(
        "the first answer of phase 2 decides",
        (
            Bug(
                "reconcile.py",
                "majority_response = min(tied, key=lambda candidate: (candidates[candidate][1], candidate))",
                "majority_response = next(iter(candidates))",
            ),
        ),
        Bounds(3, 3, "lossless"),
        ("refused",),
    ),
    PlantedBug(
        "a block arrives after phase 3 and is committed",
        (
            Bug(
                "reconcile.py",
                "    if not core.phase_three_timer.active:\n",
                "    if core.majority_response_block_hash is None:\n",
            ),
            Bug(
                "reconcile.py",
                'core.majority_response_block_hash = None\n    core.trigger("Reconcile Finalize")\n    return "gave',
                'core.trigger("Reconcile Finalize")\n    return "gave',
            ),
        ),
        Bounds(2, 2, "any"),
        ("crash",),
    ),
    PlantedBug(
        "the stack is lost at the end of a reconcile",
        (
            Bug(
                "reconcile.py",
                "    while core.reconcile_stack:\n",
                "    core.reconcile_stack.clear()\n    while core.reconcile_stack:\n",
            ),
        ),
        Bounds(2, 2, "lossless"),
        ("one chain",),
    ),
    PlantedBug(
        "the stack is lost at a reboot",
        (Bug("core.py", "        for block in stack:\n            self.push_onto_stack(block)\n", ""),),
        Bounds(2, 2, faults=("reboot",)),
        ("2",),
    ),
)
