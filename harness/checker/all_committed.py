"""Characteristic 5: in a fully connected system every completed block is in every living agent's chain, eventually."""

from harness.checker.agreement import had_a_chance, why_no_chance, why_unknown
from harness.checker.characteristic import Characteristic, Finding, agents, violated
from harness.checker.evidence import Evidence

NAME = "all committed everywhere"


def check(evidence: Evidence) -> Characteristic:
    unknown = why_unknown(evidence)
    if unknown:
        return Characteristic(NAME, "not applicable", unknown)
    completed = evidence.completed_blocks()
    lacking: dict[int, list[str]] = {}
    for agent_id, export in evidence.exports.items():
        in_chain = set(export.chain_of_block_hashes)
        missing = [block_hash for block_hash in completed if block_hash not in in_chain]
        if missing:
            lacking[agent_id] = missing
    if not lacking:
        return Characteristic(NAME, "holds", f"all {len(completed)} completed blocks are in every chain")
    no_chance = why_no_chance(evidence, set(lacking))
    if no_chance:
        lack = sum(map(len, lacking.values()))
        return Characteristic(
            NAME,
            "not applicable",
            f"{agents(set(lacking))} lack{'s' if len(lacking) == 1 else ''} {lack} copies of blocks; {no_chance}",
        )
    findings = [
        Finding(
            agent_id,
            f"reconciled while fully connected, and still lacks block {evidence.name(block_hash)}",
            evidence.name(block_hash),
            block_hash,
        )
        for agent_id in sorted(had_a_chance(evidence, set(lacking)))
        for block_hash in lacking[agent_id]
    ]
    return violated(NAME, "a completed block is not in the chain of an agent that could have it", findings)
