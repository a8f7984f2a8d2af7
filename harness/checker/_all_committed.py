"""Check characteristic 5: in a connected system, each completed block eventually reaches the chain of each living
agent.
"""

from harness.checker._agreement import (
    check_endless_cycle,
    describe_absent_agents,
    explain_no_chance,
    explain_unknown,
    find_agents_with_chance,
)
from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding, Judgement, agents, violated

NAME = "all committed everywhere"


def check(evidence: Evidence) -> Judgement:
    """Return the verdict on characteristic 5. Blocks that only killed or switched-off agents held do not count (Section
    3.3).

    The verdict is `not applicable` in three cases: an export is missing, an agent was not idle, or the agents that lack
    a block had no chance to receive this block.
    """
    if never_agrees := check_endless_cycle(NAME, evidence):
        return never_agrees
    unknown = explain_unknown(evidence)
    if unknown:
        return Judgement(NAME, "not applicable", unknown)
    gone, completed = _split_completed(evidence)
    lacking: dict[int, list[str]] = {}
    for agent_id, export in evidence.present.items():
        in_chain = set(export.chain_of_block_hashes)
        missing = [block_hash for block_hash in completed if block_hash not in in_chain]
        if missing:
            lacking[agent_id] = missing
    if not lacking and (unknown_agents := evidence.agents_with_unknown_completed()):
        one = min(unknown_agents)
        remote = evidence.remote(one)
        why = evidence.describe_unknown_name("operation", agent_id=one) or (remote.lack if remote else None)
        return Judgement(NAME, "not applicable", f"the completed blocks of {agents(unknown_agents)} are unknown: {why}")
    if not lacking:
        but = f"; {gone} more were lost with agents that {_describe_end(evidence)}" if gone else ""
        whole = f"all {len(completed)} completed blocks are in every chain"
        return Judgement(NAME, "holds", whole + describe_absent_agents(evidence) + but)
    no_chance = explain_no_chance(evidence, set(lacking))
    if no_chance:
        lack, first = sum(map(len, lacking.values())), lacking[min(lacking)][0]
        return Judgement(
            NAME,
            "not applicable",
            f"{agents(set(lacking))} lack{'s' if len(lacking) == 1 else ''} {lack} cop{'y' if lack == 1 else 'ies'} "
            f"of completed blocks, the first of block {evidence.name(first)}; {no_chance}",
        )
    findings = [
        Finding(
            agent_id,
            f"reconciled while the system was fully connected, but lacks block {evidence.name(block_hash)}",
            evidence.name(block_hash),
            block_hash,
        )
        for agent_id in sorted(find_agents_with_chance(evidence, set(lacking)))
        for block_hash in lacking[agent_id]
    ]
    return violated(NAME, "an agent that had the chance to reconcile lacks a completed block", findings)


def _split_completed(evidence: Evidence) -> tuple[int, list[str]]:
    """Return the number of lost blocks, and the hashes of all other completed blocks.

    A block is lost if two conditions are true. No present agent holds the block. The agent that completed the block was
    killed (Section 3.3 of the thesis), restarted or switched off.
    """
    completed = evidence.completed_blocks()
    exports = evidence.present.values()
    left = {block.block_hash for export in exports for block in export.blocks()}
    left.update(block_hash for export in exports for block_hash in export.completed)
    gone = {
        block_hash
        for block_hash, agent_id in completed.items()
        if block_hash not in left
        and (evidence.was_killed(agent_id) or evidence.was_restarted(agent_id) or agent_id in evidence.switched_off)
    }
    return len(gone), [block_hash for block_hash in completed if block_hash not in gone]


def _describe_end(evidence: Evidence) -> str:
    return "were killed or switched off" if evidence.switched_off else "were killed"
