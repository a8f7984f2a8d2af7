"""Decide whether agents with different chains had a chance to agree. The checks of characteristics 5 and 6 use this
decision.

An agent adapts its chain to the chains of its neighbours in a process called reconcile. A reconcile starts when a vote
fails, or when a query of another agent shows that the chains differ. Two idle agents send nothing, so their chains stay
different. This alone is no violation. A difference is a violation under two conditions: the network was fully
connected, and the agent with the different chain completed a reconcile that began after the last change of any other
chain. In all other cases the checks return `not applicable`.

The checks compare the agents that ran until the end. An agent that was switched off earlier neither sends nor receives
blocks. If all agents were switched off, the checks compare all of them. A reconcile then gives a chance to agree only
if all agents ran during the reconcile.
"""

import math

from harness.checker import recurring_cycles
from harness.checker.evidence import Evidence
from harness.checker.judgement import Judgement, agents
from harness.checker.records import cross_examine
from harness.checker.recurring_cycles import cycle_of


def check_endless_cycle(name: str, evidence: Evidence) -> Judgement | None:
    """Return the verdict `violated` if some agents repeat the same handler runs forever, although all agents took part
    and the network connects them. Return None in every other case. `harness.checker._liveness` lists the evidence.
    """
    cycle = evidence.cached(cycle_of)
    if cycle is None or evidence.connected_since_s is None or evidence.missing or evidence.paused_at_end:
        return None
    return Judgement(name, "violated", f"the system is fully connected, but {recurring_cycles.in_short(cycle)}")


MAX_REASONS = 3
"""Maximum number of agents that the reason of a verdict names."""


def explain_unknown(evidence: Evidence) -> str | None:
    """Return the reason why the exported chains are incomplete or not final: an export is missing, or an agent was not
    idle when it wrote its export. Return None if there is no such reason.
    """
    if not evidence.exports:
        return "the run has no chain exports"
    if evidence.missing:
        return f"the export of {agents(evidence.missing)} is missing"
    busy = [agent_id for agent_id, export in evidence.present.items() if not export.idle]
    if set(busy) & set(evidence.switched_off):
        return f"{agents(busy)} {'was' if len(busy) == 1 else 'were'} switched off before {_idle(busy)}"
    if busy:
        return f"{agents(busy)} {'was' if len(busy) == 1 else 'were'} not idle at the end"
    return None


def _idle(ids: list[int]) -> str:
    return "it was idle" if len(ids) == 1 else "they were idle"


def explain_no_chance(evidence: Evidence, differing: set[int]) -> str | None:
    """Return the reason why none of the `differing` agents had a chance to agree with the other agents. Return None if
    at least one of these agents had a chance.
    """
    if evidence.record is None:
        return "exports do not show whether the system was fully connected"
    since = evidence.connected_since_s
    if since is None:
        network = evidence.network_at_end or "its network conditions are not recorded"
        return f"the system was not fully connected: {network}"
    untraced = (differing | set(evidence.exports)) - set(evidence.traces)
    if untraced:
        return (
            f"the trace of {agents(untraced)} is missing, so it is unknown whether {agents(differing)} had a chance "
            "to reconcile"
        )
    if short := sorted(evidence.cached(cross_examine).short):
        return f"the trace of {agents(short)} is incomplete, so it is unknown whether there was a chance to reconcile"
    if unknown := evidence.describe_unknown_name("handler", "branch", "operation"):
        return f"it is unknown whether there was a chance to reconcile: {unknown}"
    if not find_agents_with_chance(evidence, differing):
        without = sorted(differing)
        more = len(without) - MAX_REASONS
        reasons = [_explain_agent(evidence, since, agent_id) for agent_id in without[:MAX_REASONS]]
        without_chance = f"{more} more {'agents' if more > 1 else 'agent'} had no chance"
        return "; ".join([*reasons, *([without_chance] if more > 0 else [])])
    return None


def _explain_agent(evidence: Evidence, since: float, agent_id: int) -> str:
    """Return the reason why this agent had no chance to agree with the others. The agent must have a trace."""
    changed = {peer: trace.chain_changed_at() for peer, trace in evidence.traces.items() if peer != agent_id}
    peer = max(changed, key=lambda peer: changed[peer], default=agent_id)
    when = "the system became fully connected"
    if changed.get(peer, 0.0) > since:
        since, when = changed[peer], f"the chain of agent {peer} changed last"
    proposed = [run.t for run in evidence.traces[agent_id].runs if run.branch == "proposed" and run.t >= since]
    if (there_s := evidence.presence_s)[0] > since:
        since, when = there_s[0], "others were switched off"
    within = f"that began after {since:g} s, when {when}"
    if there_s[1] < math.inf:
        within += f", and ended before {there_s[1]:g} s, when the first agent was switched off"
    if _any_was_paused(evidence, since, math.inf):
        within += ", and during which all agents were running"
    sentence = f"agent {agent_id} completed no reconcile {within}, "
    return sentence + (f"and its vote at {proposed[-1]:g} s led to none" if proposed else "and proposed no block since")


def describe_absent_agents(evidence: Evidence) -> str:
    """Return a phrase that names the switched-off agents, such as "; without agent 3, which was switched off". The
    checks ignore the chains of these agents. The phrase is empty if no agent was switched off.
    """
    away = set(evidence.exports) - set(evidence.present)
    return f"; without {agents(away)}, which {'was' if len(away) == 1 else 'were'} switched off" if away else ""


def find_agents_with_chance(evidence: Evidence, differing: set[int]) -> set[int]:
    """Return those of the `differing` agents that had a chance to agree. Such an agent completed a reconcile under
    three conditions. The network was fully connected from the beginning of the reconcile. The chains of the other
    agents did not change after this beginning. Until the end of the reconcile, no agent was paused, and exactly the
    agents whose chains are judged were running.
    """
    since = evidence.connected_since_s
    if since is None:
        return set()
    had = set()
    from_s, until_s = evidence.presence_s
    last_change = {agent_id: trace.chain_changed_at() for agent_id, trace in evidence.traces.items()}
    for agent_id in differing & set(evidence.traces):
        others_changed_at = max((t for peer, t in last_change.items() if peer != agent_id), default=0.0)
        for life in evidence.traces[agent_id].incarnations():
            began_s: float | None = None
            for _, run in life:
                if run.handler == "reconcile_begin" and run.branch == "begun":
                    began_s = run.t if run.t >= max(since, others_changed_at, from_s) else None
                elif (
                    began_s is not None
                    and run.t <= until_s
                    and run.handler == "reconcile_finalize"
                    and not run.state.reconciling
                    and not _any_was_paused(evidence, began_s, run.t)
                ):
                    had.add(agent_id)
    return had


def _any_was_paused(evidence: Evidence, from_s: float, until_s: float) -> bool:
    """Return true if an agent was paused in this interval. In this case, a query of a reconcile may not have reached
    all agents.
    """
    return any(evidence.was_paused(agent_id, from_s, until_s) for agent_id in evidence.present)
