"""Check characteristic 6: if all agents are connected and had a chance to reconcile, they all have the same chain."""

from collections import Counter

from harness.checker._agreement import (
    check_endless_cycle,
    describe_absent_agents,
    explain_no_chance,
    explain_unknown,
    find_agents_with_chance,
)
from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding, Judgement, agents, violated

NAME = "one uniform chain"


def check(evidence: Evidence) -> Judgement:
    """Judge whether the exported chains of all agents are equal.

    The verdict is `not applicable` if an export is missing, if an agent was not idle, or if the agents with different
    chains had no chance to agree.
    """
    if never_agrees := check_endless_cycle(NAME, evidence):
        return never_agrees
    unknown = explain_unknown(evidence)
    if unknown:
        return Judgement(NAME, "not applicable", unknown)
    chains = {agent_id: export.chain_of_block_hashes for agent_id, export in evidence.present.items()}
    holders = Counter(chains.values())
    if len(holders) == 1:
        who = f"{len(chains)} agents hold the same" if len(chains) > 1 else f"{agents(set(chains))} holds a"
        same = f"{who} chain of {len(next(iter(holders)))} blocks"
        return Judgement(NAME, "holds", same + describe_absent_agents(evidence))
    most_common = max(holders, key=lambda chain: (holders[chain], len(chain), chain))
    differing = {agent_id for agent_id, chain in chains.items() if chain != most_common}
    no_chance = explain_no_chance(evidence, differing)
    if no_chance:
        shared = common_prefix([*holders])
        which = f"{len(holders)} distinct chains, which share {shared} block{'s' if shared != 1 else ''}"
        return Judgement(NAME, "not applicable", f"{which}; {no_chance}")
    findings = []
    for agent_id in sorted(find_agents_with_chance(evidence, differing)):
        chain = chains[agent_id]
        shared = common_prefix([chain, most_common])
        parts = chain[shared] if shared < len(chain) else None
        detail = (
            "reconciled while the system was fully connected, but its chain differs from the most common chain "
            f"after {shared} blocks"
        )
        findings.append(Finding(agent_id, detail, evidence.name(parts) if parts else None, parts))
    return violated(NAME, "an agent that had the chance to reconcile holds a different chain", findings)


def common_prefix(chains: list[tuple[str, ...]]) -> int:
    """Return the number of blocks with which all chains begin."""
    length = 0
    for level in zip(*chains, strict=False):
        if len(set(level)) > 1:
            break
        length += 1
    return length
