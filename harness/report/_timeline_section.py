"""Show the timeline in the report: the actions of each agent, and charts of the number of copies of blocks.

Without its script the page shows the whole run, and tables list the votes and reconciles.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from markupsafe import Markup

from harness.archive.connectivity import Connectivity
from harness.archive.history import (
    LATEST_S,
    AgentReconcile,
    AgentVote,
    BroadcastMessage,
    MissionHistory,
    end_of_traces,
    history_of,
    possible_faults,
)
from harness.archive.replication import replication_of
from harness.archive.run_record import RunRecord
from harness.archive.vocabulary import first_unknown, unknown_names
from harness.present import text
from harness.present.colours import AgentColours
from harness.report import _timeline_charts, _timeline_lanes, facts
from harness.report._report_source import ReportSource
from harness.report._timeline_charts import PartitionShade, axis, format_seconds
from harness.report._timeline_lanes import OUTCOMES
from harness.report.map_parts import divisions

_HERE = Path(__file__).parent
STYLE = (_HERE / "timeline.css").read_text(encoding="utf-8")
SCRIPT = (_HERE / "timeline.js").read_text(encoding="utf-8")

MAX_ARROWS = 20_000
MAX_ROWS = 500
MAX_SHADES = 300
MAX_FAULTS = 500


@dataclass(frozen=True, slots=True)
class TimelineTable:
    """A table below the timeline."""

    rows: list[list[str]]
    left_out: int
    """Number of rows that the table omits, because it has at most `MAX_ROWS` rows."""


@dataclass(frozen=True, slots=True)
class Timeline:
    """The timeline picture."""

    end_s: float
    agents: list[tuple[int, AgentColours]]
    lane_height: int
    lanes: Markup
    legend: list[tuple[Markup, str]]
    charts: list[_timeline_charts.TimelineChart]
    axis: Markup
    messages: str
    """JSON text from which the script of the page draws arrows. The text is "null" if the page shows no messages."""
    votes: TimelineTable
    reconciles: TimelineTable


@dataclass(frozen=True, slots=True)
class TimelineSection:
    """The timeline with its tables and charts, and notes about omitted parts."""

    drawn: Timeline
    notes: list[str]


def section(left: ReportSource, names: Mapping[str, str]) -> TimelineSection | None:
    """Return the timeline section. Return None if there is no trace. `names` contains the names of blocks by hash."""
    traces, ink = left.traces, left.ink
    if not traces:
        return None
    notes = []
    faults = possible_faults(left.record.faults)
    ends_s = end_s(left)
    history = history_of(traces, faults, ends_s, whole=not left.archive.large)
    unknown = {agent: unknown_names(trace.runs) for agent, trace in sorted(traces.items())}
    incomplete = [agent for agent, words_of_agent in unknown.items() if words_of_agent]
    all_held = not any("operation" in unknown[agent] for agent in incomplete)
    if incomplete:
        first, more = first_unknown(unknown[incomplete[0]]), len(incomplete) - 1
        others = f", and such words in {more} more" if more else ""
        notes.append(f"some steps of agent {incomplete[0]} are not shown: {first} in its trace{others}")
    shades, shades_left_out = _shades(left.network, ends_s)
    if shades_left_out:
        notes.append(f"{shades_left_out} shorter partitions are not shaded")
    if len(faults) > MAX_FAULTS:
        notes.append(f"the first {MAX_FAULTS} of {len(faults)} faults and network changes are drawn")
        faults = faults[:MAX_FAULTS]
    agents = [(agent, ink[agent]) for agent in sorted(traces)]
    messages, without = _messages(history.messages, [agent for agent, _ in agents], names)
    picture = _timeline_lanes.draw(
        history,
        faults,
        shades,
        [agent for agent, _ in agents],
        names,
        ends_s,
        _in_words(history, len(agents), ends_s, bool(incomplete)),
    )
    drawn = Timeline(
        ends_s,
        agents,
        picture.lane_height,
        picture.drawing,
        picture.legend,
        [
            *([_timeline_charts.cycle_chart(left.record.cycle, ends_s)] if left.record.cycle else []),
            *(_timeline_charts.draw(replication_of(traces, faults), faults, shades, ends_s) if all_held else []),
        ],
        axis(ends_s),
        messages,
        _table(history.votes, lambda vote: _vote_row(vote, names)),
        _table(history.reconciles, _reconcile_row),
    )
    return TimelineSection(drawn, [*notes, *without, *picture.notes])


def end_s(left: ReportSource) -> float:
    """Return the mission second at which the timeline picture ends."""
    faults = possible_faults(left.record.faults)
    return max(end_of_traces(left.traces), *(fault.at_s for fault in faults), _planned_s(left.record), 1.0)


def _planned_s(record: RunRecord) -> float:
    """Return the planned duration in mission seconds if the run was completed. Return 0 otherwise."""
    if record.scenario is None or record.scenario.duration_s > LATEST_S or facts.outcome(record) is not None:
        return 0.0
    return record.scenario.duration_s


def _shades(network: Connectivity, end_s: float) -> tuple[list[PartitionShade], int]:
    """Return the `MAX_SHADES` longest partitions of the network, and the number of the omitted shorter partitions."""
    known = divisions(network.states)
    ends = [*(division.at_s for division in known[1:]), end_s]
    shades = [
        PartitionShade(division.at_s, min(until_s, end_s), division.in_words())
        for division, until_s in zip(known, ends, strict=False)
        if not division.together and division.living and division.at_s < min(until_s, end_s)
    ]
    kept = sorted(shades, key=lambda shade: shade.start_s - shade.end_s)[:MAX_SHADES]
    return sorted(kept, key=lambda shade: shade.start_s), len(shades) - len(kept)


def _messages(
    messages: Sequence[BroadcastMessage] | None, agents: Sequence[int], names: Mapping[str, str]
) -> tuple[str, list[str]]:
    """Return the received messages as JSON, and notes about omitted messages.

    The JSON holds the message names, the agent IDs, and one list for each message. This list holds the time, the row of
    the sender, the index of the message name, the block, and a pair [row, time] for each receipt.
    """
    if messages is None:
        return "null", ["Messages are not drawn, because the traces are too large"]
    received = [message for message in messages if message.receipts]
    arrows = sum(len(message.receipts) for message in received)
    if arrows > MAX_ARROWS:
        return "null", [f"Messages are not drawn, because {arrows} are too many for a page"]
    lanes = {agent: lane for lane, agent in enumerate(agents)}
    kinds = {name: place for place, name in enumerate(dict.fromkeys(message.name for message in received))}
    sent = [
        [
            round(message.at_s, 3),
            lanes[message.sender],
            kinds[message.name],
            _timeline_lanes.block_label(message.block, names) if message.block else "",
            [[lanes[agent], round(at_s, 3)] for agent, at_s in message.receipts],
        ]
        for message in received
    ]
    document = {"kinds": [name[:40] for name in kinds], "agents": list(agents), "sent": sent}
    return json.dumps(document, separators=(",", ":")), []


Span = TypeVar("Span", AgentVote, AgentReconcile)


def _table(spans: Sequence[Span], cycle_chart: Callable[[Span], list[str]]) -> TimelineTable:
    first = sorted(spans, key=lambda span: (span.start_s, span.agent))[:MAX_ROWS]
    return TimelineTable([cycle_chart(span) for span in first], len(spans) - len(first))


def _vote_row(vote: AgentVote, names: Mapping[str, str]) -> list[str]:
    return [
        format_seconds(vote.start_s),
        str(vote.agent),
        _timeline_lanes.block_label(vote.block, names),
        OUTCOMES.get(vote.outcome, vote.outcome[:40]),
        format_seconds(vote.end_s - vote.start_s),
    ]


def _reconcile_row(reconcile: AgentReconcile) -> list[str]:
    return [
        format_seconds(reconcile.start_s),
        str(reconcile.agent),
        reconcile.reason,
        _timeline_lanes.phases_in_words(reconcile) + ("" if reconcile.done else ", cut short"),
        format_seconds(reconcile.end_s - reconcile.start_s),
    ]


def _in_words(history: MissionHistory, agents: int, end_s: float, unknown: bool) -> str:
    """Return a text that describes the timeline. If `unknown` is true, the text also warns that traces contain unknown
    names, so the timeline may lack events.
    """
    approved = sum(vote.outcome == "approved" for vote in history.votes)
    return (
        f"Timeline of {agents} agents over {text.duration(round(end_s, 1))}: {len(history.votes)} votes, {approved} of"
        f" them approved, {len(history.commits)} commits, {len(history.reconciles)} reconciles,"
        f" {len(history.ties)} ties."
        " The tables below list votes and reconciles."
        f"{' The traces contain unknown words, so there may be more.' if unknown else ''}"
    )
