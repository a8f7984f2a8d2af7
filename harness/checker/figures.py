"""Figures beyond the verdicts: how far the chains agree, and what it cost."""

from collections import Counter

from harness.checker.evidence import Evidence
from harness.checker.uniform_chain import common_prefix


def figures(evidence: Evidence) -> dict[str, float | int | None]:
    """Counts of blocks and messages; None where nothing tells. `copies` are of each completed block, per agent."""
    chains = [export.chain_of_block_hashes for export in evidence.exports.values()]
    completed = evidence.completed_blocks()
    copies = Counter(block_hash for chain in chains for block_hash in set(chain))
    per_block = [copies[block_hash] for block_hash in completed]
    result: dict[str, float | int | None] = {
        "agents": len(chains),
        "blocks": len(completed),
        "mutual_chain": common_prefix(chains),
        "longest_chain": max(map(len, chains), default=0),
        "distinct_chains": len(set(chains)),
        "copies_min": min(per_block, default=None),
        "copies_mean": round(sum(per_block) / len(per_block), 3) if per_block else None,
        "reconciles": None,
        "messages": None,
        "bytes": None,
        "messages_per_block": None,
    }
    if evidence.traces:
        runs = [run for trace in evidence.traces.values() for run in trace.runs]
        messages = sum(len(run.sent) for run in runs)
        result["reconciles"] = sum(run.handler == "reconcile_begin" and run.branch == "begun" for run in runs)
        result["messages"] = messages
        result["messages_per_block"] = round(messages / len(completed), 1) if completed else None
    record = evidence.record
    if record and record.final_reconcile and set(evidence.traces) == set(evidence.exports):
        before = [trace.chain_at(record.final_reconcile.at_s) for trace in evidence.traces.values()]
        result["mutual_chain_before_final_reconcile"] = common_prefix(before)
        result["distinct_chains_before_final_reconcile"] = len(set(before))
    sent = [agent.bytes_sent for agent in record.agents.values()] if record else []
    known = [count for count in sent if count is not None]
    if known and len(known) == len(sent):
        result["bytes"] = sum(known)
    return result
