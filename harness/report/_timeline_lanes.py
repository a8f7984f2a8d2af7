"""Draw the timeline. Each agent has a row with its votes at the top, commits in the middle, and reconciles at the
bottom.

No information depends on colour alone. Votes without approval are hollow, phases of a reconcile have different heights,
faults have different shapes, and each mark has a tooltip.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import TypeVar

from markupsafe import Markup

from harness.archive.history import (
    CUT_SHORT,
    AgentReconcile,
    AgentVote,
    BlockCommit,
    MissionHistory,
    Phase2Tie,
    ReconcilePhase,
)
from harness.archive.run_record import FaultRecord
from harness.present.svg import filled, n
from harness.report._timeline_charts import (
    PartitionShade,
    draw_background,
    fault_text,
    format_number,
    format_seconds,
    pin,
    plot,
)
from harness.scenario.faults import KINDS

OUTCOMES = {
    "approved": "approved",
    "not approved": "not approved",
    "chain changed": "voted again, the chain had changed",
    "reconcile in progress": "given up for a reconcile",
    CUT_SHORT: "cut short",
}
"""The description of each outcome of a vote."""
PHASE_HEIGHTS = {"phase 1": 4, "phase 2": 7, "phase 3": 10, "finalize": 2}
BAR_HEIGHT = 7
"""Height in pixels of the bar that represents a reconcile with too many phases. Such a bar does not show single phases.
"""

MAX_BARS = 6000
MAX_COMMITS = 4000
MANY_AGENTS = 16

_TALL, _LOW = 34, 22  # height of a lane, for few agents and for many
_VOTE_HEIGHT, _PHASES_HEIGHT = 7, 10


@dataclass(frozen=True, slots=True)
class TimelinePicture:
    drawing: Markup
    lane_height: int
    legend: list[tuple[Markup, str]]
    """The legend, as pairs of a sample and its meaning."""
    notes: list[str]
    """Sentences about marks that are omitted."""


Span = TypeVar("Span", AgentVote, AgentReconcile)


def draw(
    history: MissionHistory,
    faults: Sequence[FaultRecord],
    shades: Sequence[PartitionShade],
    agents: Sequence[int],
    names: Mapping[str, str],
    end_s: float,
    description: str,
) -> TimelinePicture:
    lane_height = _TALL if len(agents) <= MANY_AGENTS else _LOW
    votes, reconciles = _longest(history.votes), _longest(history.reconciles)
    notes = [
        f"Of {len(every)} {what} the {len(drawn)} longest are drawn"
        for what, every, drawn in (("votes", history.votes, votes), ("reconciles", history.reconciles, reconciles))
        if len(drawn) < len(every)
    ]
    by_phase = sum(len(reconcile.phases) for reconcile in reconciles) <= MAX_BARS
    if not by_phase:
        notes.append("Each reconcile is drawn as one bar, because there are too many phases")
    drawn: dict[int, list[Markup]] = {agent: [] for agent in agents}
    for vote in votes:
        drawn[vote.agent].append(_vote(vote, names))
    for reconcile in reconciles:
        drawn[reconcile.agent] += _phases(reconcile, lane_height) if by_phase else [_bar(reconcile, lane_height)]
    for group in group_commits(history.commits, end_s):
        drawn[group[0].agent].append(_commit(group, lane_height, names))
    for tie in history.ties[:MAX_BARS]:
        drawn[tie.agent].append(_tie(tie, lane_height))
    height = lane_height * len(agents)
    grounds, lanes = (
        [
            Markup('<g transform="translate(0 {})">{}</g>').format(place * lane_height, Markup("").join(parts[agent]))
            for place, agent in enumerate(agents)
        ]
        for parts in ({agent: _running_background(agent, faults, lane_height, end_s) for agent in agents}, drawn)
    )
    marks = [
        pin(fault.at_s, end_s, (agents.index(agent) + 0.5) * lane_height, _mark(fault))
        for fault in faults
        for agent in fault.agents or ()
        if agent in agents and fault.kind.mark
    ]
    view = [*grounds, draw_background(shades, [fault for fault in faults if not fault.agents], height), *lanes]
    arrows = Markup('<svg class="arrows" width="100%" height="{}"></svg>').format(height)
    drawing = plot(view, [arrows, *marks], height, end_s, description)
    return TimelinePicture(drawing, lane_height, _legend(history, faults, shades, by_phase=by_phase), notes)


def _legend(
    history: MissionHistory, faults: Sequence[FaultRecord], shades: Sequence[PartitionShade], *, by_phase: bool
) -> list[tuple[Markup, str]]:
    """Return a legend for the marks in the timeline picture."""
    outcomes = {vote.outcome for vote in history.votes}
    phases = {phase.name for reconcile in history.reconciles for phase in reconcile.phases}
    entries = [
        (f'<rect class="vote {_css_class(outcome)}" x="4" y="4" width="26" height="8"/>', f"vote {label}")
        for outcome, label in (
            ("approved", "approved"),
            ("not approved", "not approved"),
            ("chain changed", "undecided"),
        )
        if any(_css_class(known) == _css_class(outcome) for known in outcomes)
    ]
    if history.commits:
        entries.append(('<path class="commit" d="M17 2v12"/>', "commit"))
    heights = {f"reconcile, {name}": PHASE_HEIGHTS[name] for name in PHASE_HEIGHTS if name in phases}
    if not by_phase:
        heights = {"reconcile": BAR_HEIGHT}
    entries += [
        (f'<rect class="reconcile" x="4" y="{13 - height}" width="26" height="{height}"/>', meaning)
        for meaning, height in heights.items()
    ]
    if history.ties:
        entries.append(('<path class="tie" d="M17 8h.01"/>', "tie"))
    suffered = {fault.kind for fault in faults if fault.agents}
    meanings = {kind.meaning: kind.mark for kind in KINDS if kind in suffered}
    entries += [
        (f'<g transform="translate(17 8)"><path class="mark" d="{mark}"/></g>', meaning)
        for meaning, mark in meanings.items()
    ]
    if shades:
        entries.append(('<rect class="shade" x="4" y="1" width="26" height="14"/>', "network partitioned"))
    if any(not fault.agents for fault in faults):
        entries.append(('<path class="change" d="M17 0v16"/>', "network changed"))
    return [
        (Markup('<svg width="34" height="16" aria-hidden="true">{}</svg>').format(Markup(shape)), meaning)  # noqa: S704
        for shape, meaning in entries
    ]


def block_label(block: str, names: Mapping[str, str]) -> str:
    """Return the name of a block. If no export contains the block, return the first 12 digits of its hash."""
    return names.get(block, block[:12])


def phases_in_words(reconcile: AgentReconcile) -> str:
    """Return a text that lists the phases of a reconcile in their order. If a phase was repeated, the text contains the
    number of its rounds.
    """
    rounds: dict[str, int] = {}
    for phase in reconcile.phases:
        rounds[phase.name] = rounds.get(phase.name, 0) + phase.rounds
    return ", ".join(f"{name} \u00d7{count}" if count > 1 else name for name, count in rounds.items()) or "no phase"


def group_commits(commits: Sequence[BlockCommit], end_s: float) -> list[list[BlockCommit]]:
    """Combine commits of the same agent that are close in time, until at most `MAX_COMMITS` marks remain. If the number
    of agents is above `MAX_COMMITS`, combine all consecutive commits of an agent.
    """
    groups = [[commit] for commit in commits]
    for within_s in (end_s / parts for parts in (4096, 2048, 1024, 512, 256, 128, 64, 32, 16, 8, 4, 2, 1)):
        if len(groups) <= MAX_COMMITS:
            break
        groups = []
        for commit in commits:
            if groups and groups[-1][0].agent == commit.agent and commit.at_s - groups[-1][0].at_s <= within_s:
                groups[-1].append(commit)
            else:
                groups.append([commit])
    return groups


def _longest(spans: Sequence[Span]) -> list[Span]:
    """Return the `MAX_BARS` longest intervals in order of time. Among intervals with equal lengths, the earlier ones
    are preferred.
    """
    kept = sorted(spans, key=lambda span: (round(span.start_s - span.end_s, 3), span.start_s))[:MAX_BARS]
    return sorted(kept, key=attrgetter("start_s"))


def _css_class(outcome: str) -> str:
    """Return the CSS class of a vote with this result. Any result other than approval and disapproval counts as
    undecided.
    """
    return {"approved": "approved", "not approved": "refused"}.get(outcome, "undecided")


def _vote(vote: AgentVote, names: Mapping[str, str]) -> Markup:
    tip = f"agent {vote.agent}: vote on {block_label(vote.block, names)}, {_from_to(vote)}:"
    return filled(
        '<rect class="vote {}" x="{}" y="3" width="{}" height="{}"><title>{}</title></rect>',
        _css_class(vote.outcome),
        format_number(vote.start_s),
        format_number(vote.end_s - vote.start_s),
        _VOTE_HEIGHT,
        f"{tip} {OUTCOMES.get(vote.outcome, vote.outcome[:40])}",
    )


def _phases(reconcile: AgentReconcile, lane_height: int) -> list[Markup]:
    return [
        _reconcile_bar(
            phase,
            PHASE_HEIGHTS[phase.name],
            lane_height,
            f"agent {reconcile.agent}: reconcile ({reconcile.reason}), {phase.name}"
            + (f", {phase.rounds} rounds" if phase.rounds > 1 else ""),
        )
        for phase in reconcile.phases
    ]


def _bar(reconcile: AgentReconcile, lane_height: int) -> Markup:
    tip = f"agent {reconcile.agent}: reconcile ({reconcile.reason}), {phases_in_words(reconcile)}"
    return _reconcile_bar(reconcile, BAR_HEIGHT, lane_height, tip)


def _reconcile_bar(span: ReconcilePhase | AgentReconcile, height: int, lane_height: int, tip: str) -> Markup:
    return filled(
        '<rect class="reconcile" x="{}" y="{}" width="{}" height="{}"><title>{}</title></rect>',
        format_number(span.start_s),
        lane_height - 3 - height,
        format_number(span.end_s - span.start_s),
        height,
        f"{tip}, {_from_to(span)}",
    )


def _from_to(span: AgentVote | AgentReconcile | ReconcilePhase) -> str:
    return f"{format_seconds(span.start_s)} to {format_seconds(span.end_s)}"


def _commit(group: Sequence[BlockCommit], lane_height: int, names: Mapping[str, str]) -> Markup:
    first, last = group[0], group[-1]
    tip = f"agent {first.agent} commits {block_label(first.block, names)} ({first.how}), {format_seconds(first.at_s)}"
    if len(group) > 1:
        times = f"{format_seconds(first.at_s)} to {format_seconds(last.at_s)}"
        tip = f"agent {first.agent} commits {len(group)} blocks, {times}"
    top, bottom = _VOTE_HEIGHT + 4, lane_height - _PHASES_HEIGHT - 1
    if bottom - top < 6:
        top, bottom = 2, lane_height - 2
    return filled(
        '<path class="commit" d="M{} {}V{}"><title>{}</title></path>',
        format_number(first.at_s),
        top,
        bottom,
        tip,
    )


def _tie(tie: Phase2Tie, lane_height: int) -> Markup:
    """Draw the mark of a tied vote as a dot. The dot is a line with length 0 and round ends, so that it stays round
    when the picture is stretched.
    """
    return Markup('<path class="tie" d="M{} {}h0"><title>{}</title></path>').format(
        format_number(tie.at_s),
        n(lane_height - 3 - _PHASES_HEIGHT / 2),
        f"agent {tie.agent}: {tie.branch[:60]}, {format_seconds(tie.at_s)}",
    )


def _running_background(agent: int, faults: Sequence[FaultRecord], lane_height: int, end_s: float) -> list[Markup]:
    """Draw the background of an agent's row for the times when the agent runs. For the times when the agent is paused,
    draw a broken line.
    """
    ran: list[tuple[float, float]] = []
    paused: list[tuple[float, float]] = []
    since_s: float | None = 0.0
    paused_s: float | None = None
    for fault in (fault for fault in faults if agent in (fault.agents or ())):
        if fault.kind.ends_incarnation and since_s is not None:
            ran.append((since_s, fault.at_s))
            since_s = None
        elif fault.kind.begins_incarnation and since_s is None:
            since_s = fault.at_s
        elif fault.kind.suspends_agent and paused_s is None:
            paused_s = fault.at_s
        if not fault.kind.suspends_agent and paused_s is not None:
            paused.append((paused_s, fault.at_s))
            paused_s = None
    ran += [(since_s, end_s)] if since_s is not None else []
    paused += [(paused_s, end_s)] if paused_s is not None else []
    grounds = [
        Markup('<rect class="ran" x="{}" y="1" width="{}" height="{}"/>').format(
            format_number(start_s), format_number(until_s - start_s), lane_height - 2
        )
        for start_s, until_s in ran
    ]
    stills = [
        Markup('<path class="paused" d="M{} {}H{}"><title>{}</title></path>').format(
            format_number(start_s),
            n(lane_height / 2),
            format_number(until_s),
            f"agent {agent} is paused, {format_seconds(start_s)} to {format_seconds(until_s)}",
        )
        for start_s, until_s in paused
    ]
    return grounds + stills


def _mark(fault: FaultRecord) -> Markup:
    return Markup('<path class="mark" d="{}"><title>{}</title></path>').format(fault.kind.mark, fault_text(fault))
