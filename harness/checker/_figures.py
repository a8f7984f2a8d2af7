"""Compute the numeric results of a run, for example the number of different chains and the number of messages."""

from collections import Counter

from harness.checker.evidence import Evidence
from harness.checker.records import cross_examine
from harness.checker.uniform_chain import common_prefix


def figures(evidence: Evidence) -> dict[str, float | int | None]:
    """Return the numeric results of a run by name. A result of None is unknown.

    `copies_min` and `copies_mean` are the minimum and the mean number of chains that contain a completed block.
    `uniform_at_s` is the mission second since which all chains are equal, or None if they differ.
    """
    chains = [export.chain_of_block_hashes for export in evidence.exports.values()]
    completed = evidence.completed_blocks()
    all_known = not evidence.agents_with_unknown_completed()
    copies = Counter(block_hash for chain in chains for block_hash in chain)
    per_block = [copies[block_hash] for block_hash in completed]
    distinct = len(set(chains))
    messages = _sum_over_agents(evidence, "messages_sent")
    result: dict[str, float | int | None] = {
        "agents": len(chains),
        "blocks": len(completed) if all_known else None,
        "mutual_chain": common_prefix(chains),
        "longest_chain": max(map(len, chains), default=0),
        "distinct_chains": distinct,
        "copies_min": min(per_block, default=None) if all_known else None,
        "copies_mean": round(sum(per_block) / len(per_block), 3) if per_block and all_known else None,
        "uniform_at_s": compute_uniform_at_s(evidence),
        "reconciles": _sum_over_agents(evidence, "reconciles"),
        "messages": messages,
        "bytes": _sum_over_agents(evidence, "bytes_sent"),
        "messages_per_block": round(messages / len(completed), 1)
        if completed and messages is not None and all_known
        else None,
    }
    if evidence.record and (channel := evidence.record.channel):
        result["collisions"] = channel.total("collision")
        result["airtime_s"] = round(channel.airtime_s, 3)
        result["airtime_per_block_s"] = (
            round(channel.airtime_s / len(completed), 3) if completed and all_known else None
        )
    if evidence.before_final_reconcile:
        before = [export.chain_of_block_hashes for export in evidence.before_final_reconcile.values()]
        result["mutual_chain_before_final_reconcile"] = common_prefix(before)
        result["distinct_chains_before_final_reconcile"] = len(set(before))
    return result


def _sum_over_agents(evidence: Evidence, counter: str) -> int | None:
    """Return the sum of a counter over all agents. Return None if neither run.json nor the traces contain it
    completely.
    """
    agents = evidence.record.agents.values() if evidence.record else ()
    counts: list[int | None] = [getattr(agent, counter) for agent in agents]
    known = [count for count in counts if count is not None]
    if known and len(known) == len(counts):
        return sum(known)
    runs = [run for trace in evidence.traces.values() for run in trace.runs]
    if not runs or evidence.cached(cross_examine).short:
        return None
    match counter:
        case "messages_sent":
            return sum(len(run.sent) for run in runs)
        case "reconciles" if evidence.describe_unknown_name("handler", "branch") is None:
            return sum(run.handler == "reconcile_begin" and run.branch == "begun" for run in runs)
    return None


def compute_uniform_at_s(evidence: Evidence) -> float | None:
    """Return the mission second since which all chains are equal. This is the time of the last change of any chain.

    Return None if the chains differ at the end, or if no record contains these changes.
    """
    if len({export.chain_of_block_hashes for export in evidence.exports.values()}) != 1:
        return None
    recorded = evidence.record.agents if evidence.record else {}
    last_s = 0.0
    for agent_id in evidence.exports:
        agent, trace = recorded.get(str(agent_id)), evidence.traces.get(agent_id)
        if agent is not None and agent.chain_changed_at_s is not None:
            last_s = max(last_s, agent.chain_changed_at_s)
        elif evidence.describe_unknown_name("operation", agent_id=agent_id):
            return None
        elif trace is not None and agent_id not in evidence.cached(cross_examine).short:
            last_s = max(last_s, round(trace.chain_changed_at(), 3))
        else:
            return None
    return last_s
