"""What characteristics 5 and 6 share: whether agents that differ have had their chance to agree.

Two idle agents with different chains stay different, since only a vote or another's phase 2 query starts a reconcile.
So a difference is a violation only where full connectivity is on record, and since then a completed reconcile of the
differing agent that began after the others' chains had stopped changing. Else the characteristics do not apply.
"""

from harness.checker.evidence import Evidence
from harness.checker.judgement import agents


def why_unknown(evidence: Evidence) -> str | None:
    """Why equal or unequal exports say nothing about the whole system; None if all of it is there and idle."""
    if not evidence.exports:
        return "there is no export to look at"
    if evidence.missing:
        return f"there is no export of {agents(evidence.missing)}"
    busy = [agent_id for agent_id, export in evidence.exports.items() if not export.idle]
    if busy:
        return f"{agents(busy)} had not finished"
    return None


def why_no_chance(evidence: Evidence, differing: set[int]) -> str | None:
    """Why none of the differing agents has had the chance to agree; None if at least one has."""
    if evidence.record is None:
        return "exports alone do not tell whether the system was fully connected"
    since = evidence.connected_since_s
    if since is None:
        return f"the system was not fully connected: {evidence.network_at_end or 'its conditions are not on record'}"
    untraced = differing - set(evidence.traces)
    if untraced:
        return f"there is no trace of {agents(untraced)} to tell whether they had the chance to reconcile"
    if not had_a_chance(evidence, differing):
        return (
            f"{agents(differing)} differ{'s' if len(differing) == 1 else ''} by blocks after which neither a vote nor "
            "a reconcile took place"
        )
    return None


def had_a_chance(evidence: Evidence, differing: set[int]) -> set[int]:
    """Those of `differing` that completed a reconcile since full connectivity and the others' last change."""
    since = evidence.connected_since_s
    if since is None:
        return set()
    had = set()
    last_change = {agent_id: trace.chain_changed_at() for agent_id, trace in evidence.traces.items()}
    for agent_id in differing & set(evidence.traces):
        others_changed_at = max((t for peer, t in last_change.items() if peer != agent_id), default=0.0)
        for life in evidence.traces[agent_id].lives():
            began = False
            for _, run in life:
                if run.handler == "reconcile_begin" and run.branch == "begun":
                    began = run.t >= max(since, others_changed_at)
                elif began and run.handler == "reconcile_finalize" and not run.state.reconciling:
                    had.add(agent_id)
    return had
