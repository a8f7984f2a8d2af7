"""Check liveness: after the last event, the swarm becomes idle with all completed blocks committed.

A swarm that is not idle at the end may only need more time, or it may never finish. The check reports an endless cycle
only if the records prove it. If agents still commit blocks, the rate of these commits gives an estimate of the
remaining time.
"""

from harness.checker import recurring_cycles
from harness.checker._agreement import describe_absent_agents
from harness.checker._figures import compute_uniform_at_s
from harness.checker.evidence import Evidence
from harness.checker.judgement import MAX_EVIDENCE, Finding, Judgement, agents

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
