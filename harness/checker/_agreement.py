"""What characteristics 5 and 6 share: whether agents that differ have had their chance to agree.

Two idle agents with different chains stay different, since only a vote or another's phase 2 query starts a reconcile.
So a difference is a violation only where full connectivity is on record, and since then a completed reconcile of the
differing agent that began after the others' chains had stopped changing. Else the characteristics do not apply.

The system is whoever was there to the end: an agent that was switched off before tells nobody what it holds, and learns
nothing. Where everybody was switched off it is all of them, and a chance only one that nobody missed.
"""

import math

from harness.checker import recurring_cycles
from harness.checker.evidence import Evidence
from harness.checker.judgement import Judgement, agents
from harness.checker.records import cross_examine
from harness.checker.recurring_cycles import cycle_of


def never(name: str, evidence: Evidence) -> Judgement | None:
    """Violated, where everybody is there and hears everybody, and yet some are shown never to finish; else None.

    `harness.checker._liveness` has the evidence.
    """
    cycle = evidence.once(cycle_of)
    if cycle is None or evidence.connected_since_s is None or evidence.missing or evidence.paused_at_end:
        return None
    return Judgement(name, "violated", f"the system is fully connected, but {recurring_cycles.in_short(cycle)}")


REASONS_TOLD = 3
"""Of more agents nobody reads why they had no chance."""


def why_unknown(evidence: Evidence) -> str | None:
    """Why equal or unequal exports say nothing about the whole system; None if all of it is there and idle."""
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


def why_no_chance(evidence: Evidence, differing: set[int]) -> str | None:
    """Why none of the differing agents has had the chance to agree; None if at least one has."""
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
    if short := sorted(evidence.once(cross_examine).short):
        return f"the trace of {agents(short)} is incomplete, so it is unknown whether there was a chance to reconcile"
    if unknown := evidence.unknown_word("handler", "branch", "operation"):
        return f"it is unknown whether there was a chance to reconcile: {unknown}"
    if not had_a_chance(evidence, differing):
        without = sorted(differing)
        more = len(without) - REASONS_TOLD
        told = [_why_none(evidence, since, agent_id) for agent_id in without[:REASONS_TOLD]]
        without_chance = f"{more} more {'agents' if more > 1 else 'agent'} had no chance"
        return "; ".join([*told, *([without_chance] if more > 0 else [])])
    return None


def _why_none(evidence: Evidence, since: float, agent_id: int) -> str:
    """Why this agent, whose trace is there, has had no chance."""
    changed = {peer: trace.chain_changed_at() for peer, trace in evidence.traces.items() if peer != agent_id}
    peer = max(changed, key=lambda peer: changed[peer], default=agent_id)
    when = "the system became fully connected"
    if changed.get(peer, 0.0) > since:
        since, when = changed[peer], f"the chain of agent {peer} changed last"
    proposed = [run.t for run in evidence.traces[agent_id].runs if run.branch == "proposed" and run.t >= since]
    if (there_s := evidence.all_there_s)[0] > since:
        since, when = there_s[0], "others were switched off"
    within = f"that began after {since:g} s, when {when}"
    if there_s[1] < math.inf:
        within += f", and ended before {there_s[1]:g} s, when the first agent was switched off"
    if _somebody_stood_still(evidence, since, math.inf):
        within += ", and during which all agents were running"
    sentence = f"agent {agent_id} completed no reconcile {within}, "
    return sentence + (f"and its vote at {proposed[-1]:g} s led to none" if proposed else "and proposed no block since")


def without(evidence: Evidence) -> str:
    """Of whom the exports that agree are not, for the end of a sentence."""
    away = set(evidence.exports) - set(evidence.present)
    return f"; without {agents(away)}, which {'was' if len(away) == 1 else 'were'} switched off" if away else ""


def had_a_chance(evidence: Evidence, differing: set[int]) -> set[int]:
    """Those of `differing` that completed a reconcile since full connectivity and the others' last change.

    One during which nobody was missing or stood still whose export is judged, and nobody else was there.
    """
    since = evidence.connected_since_s
    if since is None:
        return set()
    had = set()
    from_s, until_s = evidence.all_there_s
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
                    and not _somebody_stood_still(evidence, began_s, run.t)
                ):
                    had.add(agent_id)
    return had


def _somebody_stood_still(evidence: Evidence, from_s: float, until_s: float) -> bool:
    """Whether one of those who are judged neither heard nor answered for a while: who asks then asks not all."""
    return any(evidence.was_paused(agent_id, from_s, until_s) for agent_id in evidence.present)
