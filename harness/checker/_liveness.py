"""Check liveness: after the last event, the swarm becomes idle with all completed blocks committed.

A swarm that is not idle at the end may only need more time, or it may never finish. The check reports an endless cycle
only if the records prove it. If agents still commit blocks, the rate of these commits gives an estimate of the
remaining time.

`figures` returns the numeric results of a run, for example the number of different chains and the number of messages.
"""

from collections import Counter

from harness.checker import recurring_cycles
from harness.checker._agreement import describe_absent_agents
from harness.checker.evidence import Evidence
from harness.checker.judgement import MAX_EVIDENCE, Finding, Judgement, agents
from harness.checker.records import cross_examine
from harness.checker.uniform_chain import common_prefix


def figures(evidence: Evidence) -> dict[str, float | int | None]:
    """Return the numeric results of a run by name. The value of an unknown result is None.

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
    """Return the mission second since which all chains are equal: the time of the last change of any chain.

    Return None if the chains differ at the end, or if the time of a change is not recorded.
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


NAME = "liveness"


def check(evidence: Evidence) -> Judgement:
    """Return the verdict on liveness: `finished`, `not finished`, `never finishes` or `not applicable`. The verdict is
    `never finishes` if the records show an endless cycle.
    """
    unknown = _explain_unknown(evidence)
    if unknown:
        return Judgement(NAME, "not applicable", unknown)
    if not evidence.busy:
        return Judgement(NAME, "finished", _describe_idle_end(evidence))
    cycle = evidence.cached(recurring_cycles.cycle_of)
    if cycle is not None:
        return Judgement(NAME, "never finishes", recurring_cycles.in_words(cycle), recurring_cycles.findings(cycle))
    findings = [Finding(agent_id, _describe_open_work(evidence, agent_id)) for agent_id in evidence.busy]
    return Judgement(NAME, "not finished", _describe_busy_end(evidence), findings[:MAX_EVIDENCE])


def _explain_unknown(evidence: Evidence) -> str | None:
    if evidence.record is None:
        return "exports do not show whether the run ended normally"
    if evidence.record.outcome != "completed":
        return f"the run did not end normally ({evidence.record.outcome})"
    if not evidence.exports:
        return "the run has no chain exports"
    if evidence.missing:
        return f"the export of {agents(evidence.missing)} is missing"
    early = [agent_id for agent_id in evidence.switched_off if not evidence.exports[agent_id].idle]
    if early and set(evidence.present) <= set(evidence.switched_off):
        return f"{agents(early)} {'was' if len(early) == 1 else 'were'} switched off before the swarm was idle"
    if evidence.paused_at_end and not evidence.busy:
        return f"{agents(evidence.paused_at_end)} stayed paused to the end"
    return None


def _describe_idle_end(evidence: Evidence) -> str:
    there = evidence.present
    idle = f"all {len(there)} agents were idle" if len(there) > 1 else "the agent was idle"
    when = "" if evidence.ended_at_s is None else f" at {evidence.ended_at_s:.0f} s"
    at = " when they were switched off" if set(there) <= set(evidence.switched_off) else when
    chains = len({export.chain_of_block_hashes for export in there.values()})
    uniform_s = compute_uniform_at_s(evidence)
    since = "" if uniform_s is None else f" since {uniform_s:.1f} s"
    one = "one chain" if chains == 1 else f"{chains} distinct chains"
    return f"{idle}{at}, with {one}{since}{describe_absent_agents(evidence)}"


def _describe_busy_end(evidence: Evidence) -> str:
    still = f"{recurring_cycles.named(evidence.busy)} {'were' if len(evidence.busy) > 1 else 'was'} not idle"
    at = "" if evidence.ended_at_s is None else f" when the run ended at {evidence.ended_at_s:.0f} s"
    connected = evidence.connected_since_s is not None
    conditions = (
        "" if connected else f", not fully connected ({evidence.network_at_end or 'network conditions not recorded'})"
    )
    return f"{still}{at}{conditions}; {_estimate_remaining_time(evidence)}"


def _estimate_remaining_time(evidence: Evidence) -> str:
    """Return a sentence that estimates the remaining time from the rate of commits since the last completed block."""
    waiting = sum(len(export.blocks_to_be_committed) for export in evidence.exports.values())
    blocks = f"{waiting} block{'s' if waiting != 1 else ''} waited for their commit"
    if not waiting:
        return "no block waited for its commit, and it is unknown whether the agents would have become idle"
    if not evidence.traces or evidence.ended_at_s is None:
        return f"{blocks}, and without traces the commit rate is unknown"
    runs = [run for trace in evidence.traces.values() for run in trace.runs]
    last_completed_s = max(
        (run.t for run in runs if any(operation == "complete" for operation, _ in run.changes)), default=0.0
    )
    committed_at = [run.t for run in runs for operation, _ in run.changes if operation == "deque-"]
    minutes = (evidence.ended_at_s - last_completed_s) / 60
    if not any(at_s > evidence.ended_at_s - 30 * minutes for at_s in committed_at):
        return (
            f"{blocks}, and none was committed in the last {minutes / 2:.1f} minutes, so it is unknown whether "
            "they would have been committed"
        )
    rate = sum(at_s > last_completed_s for at_s in committed_at) / minutes
    more = max(1, round(waiting / rate))
    return f"{blocks}; at {rate:.2g} commits a minute this would have taken {more} minute{'s' if more > 1 else ''} more"


def _describe_open_work(evidence: Evidence, agent_id: int) -> str:
    export = evidence.exports[agent_id]
    waiting, aside = len(export.blocks_to_be_committed), len(export.reconcile_stack)
    doing = "in a reconcile" if export.reconcile_in_progress else "not in a reconcile"
    return f"not idle at the end, {doing}; blocks to be committed: {waiting}, on the reconcile stack: {aside}"
