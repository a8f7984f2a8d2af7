"""The timeline: what each agent did along mission time, and under it how far the data had spread.

The page is whole without its script: the pictures then show the whole run, and the tables what is in them.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from markupsafe import Markup

from harness.archive.connectivity import Connectivity
from harness.archive.history import LATEST_S, History, Message, Reconcile, Vote, ends_at, history_of, possible
from harness.archive.replication import replication_of
from harness.archive.run_record import RunRecord
from harness.archive.vocabulary import first_of, unknown_words
from harness.present import text
from harness.present.colours import Ink
from harness.report import _timeline_charts, _timeline_lanes, facts
from harness.report._report_source import ReportSource
from harness.report._timeline_lanes import OUTCOMES
from harness.report._timeline_plot import Shade, axis, seconds
from harness.report.map_parts import divisions

_HERE = Path(__file__).parent
STYLE = (_HERE / "timeline.css").read_text(encoding="utf-8")
SCRIPT = (_HERE / "timeline.js").read_text(encoding="utf-8")

MAX_ARROWS = 20_000
MAX_ROWS = 500
MAX_SHADES = 300
MAX_FAULTS = 500


@dataclass(frozen=True, slots=True)
class Table:
    """`left_out` says how many rows there were no room for."""

    rows: list[list[str]]
    left_out: int


@dataclass(frozen=True, slots=True)
class Drawn:
    """`messages` is what the script draws arrows from, as JSON: null if they are left out."""

    end_s: float
    agents: list[tuple[int, Ink]]
    lane_height: int
    lanes: Markup
    legend: list[tuple[Markup, str]]
    charts: list[_timeline_charts.Chart]
    axis: Markup
    messages: str
    votes: Table
    reconciles: Table


@dataclass(frozen=True, slots=True)
class Section:
    """`notes` say what was left out."""

    drawn: Drawn
    notes: list[str]


def section(left: ReportSource, names: Mapping[str, str]) -> Section | None:
    """`names` are those of blocks by hash. None if there is no trace."""
    traces, ink = left.traces, left.ink
    if not traces:
        return None
    notes = []
    faults = possible(left.record.faults)
    ends_s = end_s(left)
    course = history_of(traces, faults, ends_s, whole=not left.archive.large)
    unknown = {agent: unknown_words(trace.runs) for agent, trace in sorted(traces.items())}
    untold = [agent for agent, words_of_agent in unknown.items() if words_of_agent]
    all_held = not any("operation" in unknown[agent] for agent in untold)
    if untold:
        first, more = first_of(unknown[untold[0]]), len(untold) - 1
        others = f", and such words in {more} more" if more else ""
        notes.append(f"some steps of agent {untold[0]} are not shown: {first} in its trace{others}")
    shades, shades_left_out = _shades(left.network, ends_s)
    if shades_left_out:
        notes.append(f"{shades_left_out} shorter partitions are not shaded")
    if len(faults) > MAX_FAULTS:
        notes.append(f"the first {MAX_FAULTS} of {len(faults)} faults and network changes are drawn")
        faults = faults[:MAX_FAULTS]
    agents = [(agent, ink[agent]) for agent in sorted(traces)]
    messages, without = _messages(course.messages, [agent for agent, _ in agents], names)
    picture = _timeline_lanes.draw(
        course,
        faults,
        shades,
        [agent for agent, _ in agents],
        names,
        ends_s,
        _in_words(course, len(agents), ends_s, bool(untold)),
    )
    drawn = Drawn(
        ends_s,
        agents,
        picture.lane_height,
        picture.drawing,
        picture.legend,
        [
            *([_timeline_charts.row(left.record.cycle, ends_s)] if left.record.cycle else []),
            *(_timeline_charts.draw(replication_of(traces, faults), faults, shades, ends_s) if all_held else []),
        ],
        axis(ends_s),
        messages,
        _table(course.votes, lambda vote: _vote_row(vote, names)),
        _table(course.reconciles, _reconcile_row),
    )
    return Section(drawn, [*notes, *without, *picture.notes])


def end_s(left: ReportSource) -> float:
    """When what is drawn of a run is over, in mission seconds."""
    faults = possible(left.record.faults)
    return max(ends_at(left.traces), *(fault.at_s for fault in faults), _planned_s(left.record), 1.0)


def _planned_s(record: RunRecord) -> float:
    """How many mission seconds the run was to last, if it did not end before."""
    if record.scenario is None or record.scenario.duration_s > LATEST_S or facts.outcome(record) is not None:
        return 0.0
    return record.scenario.duration_s


def _shades(network: Connectivity, end_s: float) -> tuple[list[Shade], int]:
    """When the network was parted, and how many shorter times there were no room for."""
    known = divisions(network.states)
    ends = [*(division.at_s for division in known[1:]), end_s]
    shades = [
        Shade(division.at_s, min(until_s, end_s), division.in_words())
        for division, until_s in zip(known, ends, strict=False)
        if not division.together and division.living and division.at_s < min(until_s, end_s)
    ]
    kept = sorted(shades, key=lambda shade: shade.start_s - shade.end_s)[:MAX_SHADES]
    return sorted(kept, key=lambda shade: shade.start_s), len(shades) - len(kept)


def _messages(
    messages: Sequence[Message] | None, agents: Sequence[int], names: Mapping[str, str]
) -> tuple[str, list[str]]:
    """Names of messages, agents, and of each message: when, from which lane, name, block, and [lane, when] handled."""
    if messages is None:
        return "null", ["Messages are not drawn, because the traces are too large"]
    heard = [message for message in messages if message.receipts]
    arrows = sum(len(message.receipts) for message in heard)
    if arrows > MAX_ARROWS:
        return "null", [f"Messages are not drawn, because {arrows} are too many for a page"]
    lanes = {agent: lane for lane, agent in enumerate(agents)}
    kinds = {name: place for place, name in enumerate(dict.fromkeys(message.name for message in heard))}
    sent = [
        [
            round(message.at_s, 3),
            lanes[message.sender],
            kinds[message.name],
            _timeline_lanes.named(message.block, names) if message.block else "",
            [[lanes[agent], round(at_s, 3)] for agent, at_s in message.receipts],
        ]
        for message in heard
    ]
    document = {"kinds": [name[:40] for name in kinds], "agents": list(agents), "sent": sent}
    return json.dumps(document, separators=(",", ":")), []


Span = TypeVar("Span", Vote, Reconcile)


def _table(spans: Sequence[Span], row: Callable[[Span], list[str]]) -> Table:
    first = sorted(spans, key=lambda span: (span.start_s, span.agent))[:MAX_ROWS]
    return Table([row(span) for span in first], len(spans) - len(first))


def _vote_row(vote: Vote, names: Mapping[str, str]) -> list[str]:
    return [
        seconds(vote.start_s),
        str(vote.agent),
        _timeline_lanes.named(vote.block, names),
        OUTCOMES.get(vote.outcome, vote.outcome[:40]),
        seconds(vote.end_s - vote.start_s),
    ]


def _reconcile_row(reconcile: Reconcile) -> list[str]:
    return [
        seconds(reconcile.start_s),
        str(reconcile.agent),
        reconcile.reason,
        _timeline_lanes.phases_in_words(reconcile) + ("" if reconcile.done else ", cut short"),
        seconds(reconcile.end_s - reconcile.start_s),
    ]


def _in_words(course: History, agents: int, end_s: float, unknown: bool) -> str:
    """What the lanes show, for who does not see them; with `unknown` words in traces there may be more."""
    approved = sum(vote.outcome == "approved" for vote in course.votes)
    return (
        f"Timeline of {agents} agents over {text.duration(round(end_s, 1))}: {len(course.votes)} votes, {approved} of"
        f" them approved, {len(course.commits)} commits, {len(course.reconciles)} reconciles, {len(course.ties)} ties."
        " The tables below list votes and reconciles."
        f"{' The traces contain unknown words, so there may be more.' if unknown else ''}"
    )
