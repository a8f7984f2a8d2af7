"""Write the page of a merged record: one HTML file that loads no other files and runs no script.

The page shows a map of the events, a chart over time, and the blocks that each vehicle holds. The template escapes all
data from vehicles.
"""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from harness.archive.exports import Export
from harness.field.depot.consolidation import MergedRecord
from harness.field.depot.depot_reconcile import ReconciledExports
from harness.field.depot.page import _holdings, _position_map, _time_chart
from harness.field.depot.record_lines import Block
from harness.field.depot.record_outputs import (
    agents,
    flight_logs,
    flown_tracks,
    fork_in_words,
    in_words,
    reconciled_in_words,
    tracks,
)
from harness.field.flight_logs._matching import MatchedLog, changes
from harness.present import text as text_module
from harness.present.colours import AgentColours, inks
from harness.report import html
from harness.report.chain_tree_svg import STYLE as TREE_STYLE
from harness.report.chain_tree_svg import ChainTreePicture
from harness.report.map_svg import STYLE as MAP_STYLE
from ucp.clock import MICROSECONDS

__all__ = ["draw"]

_TEMPLATE = Path(__file__).with_name("page.html.j2")
_STYLE = _TEMPLATE.with_name("page.css").read_text(encoding="utf-8")
MAX_ROWS = 3_000
MAX_TREE_BLOCKS = 10_000
MAX_TITLE = 100


def draw(record: MergedRecord, reconciliation: ReconciledExports | None = None) -> str:
    """Return the page of a merged record as HTML."""
    header = record.header
    ink = inks(header.roster)
    when = _time_chart.time_span_of(record)
    agent_tracks = tracks(record)
    matches = flight_logs(record)
    marks = _marks(matches)
    if when is not None:
        when = _time_chart.extended(when, (mark for of_agent in marks.values() for mark in of_agent))
    flown = flown_tracks(matches)
    single_copies = [block.line.name for block in record.blocks if len(block.line.holders) < 2]
    lost: dict[int, list[int]] = {}
    for missing_block in record.lost_blocks:
        lost.setdefault(missing_block.agent_id, []).append(int((missing_block.block or "").partition(".")[2]))
    reconciled = reconciliation.line if reconciliation else None
    return html.render(
        _TEMPLATE,
        styles=[TREE_STYLE + MAP_STYLE + html.PAGE_STYLE + _STYLE],
        title=_title(record),
        headline=_headline(record),
        summary=_summary(record, when),
        sentences=list(in_words(record)),
        findings=[
            ("These exports have errors. Their undamaged parts are used.", header.problems),
            ("Not all files are used.", header.left_out),
        ],
        remarks=header.remarks,
        figures=_figures(record, single_copies),
        map=_position_map.draw(agent_tracks, single_copies, lost, ink, flown) if agent_tracks or flown else None,
        changes=_changes(matches, ink),
        when=when,
        began=text_module.moment(when.first_us) if when else "",
        ended=text_module.moment(when.last_us) if when else "",
        along=_time_chart.draw(record, when, ink, marks) if when else None,
        shades=range(_time_chart.SHADES),
        holdings=_holdings.draw(record),
        places=_holdings.PLACES,
        forks=[fork_in_words(fork) for fork in record.forks],
        trees=_trees(record, reconciliation, ink),
        lost=record.lost,
        reconciled=list(reconciled_in_words(reconciled)) if reconciled else None,
        gains=[(vehicle, ink[vehicle.agent_id]) for vehicle in reconciled.vehicles] if reconciled else [],
        vehicles=_vehicles(record, ink),
        blocks=[_row(block.line, ink) for block in record.blocks[:MAX_ROWS]],
        blocks_left_out=max(0, len(record.blocks) - MAX_ROWS),
    )


def _title(record: MergedRecord) -> str:
    """Return the title of the page. If the data of the inception block are readable text, they are the title. Otherwise
    the title contains the hash of the inception block.
    """
    text = base64.b64decode(record.header.inception.block_data).decode("utf-8", errors="replace")
    if text and text.isprintable() and "\ufffd" not in text:
        return text if len(text) <= MAX_TITLE else f"{text[: MAX_TITLE - 1]}…"
    return f"Mission {record.header.inception.block_hash[:12]}"


def _headline(record: MergedRecord) -> tuple[str, str]:
    """Return a short headline about the record, and the style of the headline."""
    losses = []
    if record.missing:
        losses.append("1 vehicle" if len(record.missing) == 1 else f"{len(record.missing)} vehicles")
    if record.lost_blocks:
        losses.append("1 block" if len(record.lost_blocks) == 1 else f"{len(record.lost_blocks)} blocks")
    if losses:
        return f"{' and '.join(losses)} lost", "violated"
    if record.header.problems or record.header.left_out:
        return "the files have errors", "violated"
    return "no known losses", "holds"


def _summary(record: MergedRecord, when: _time_chart.TimeSpan | None) -> list[str]:
    header = record.header
    parts = [f"inception block {header.inception.block_hash[:12]}"]
    if when is not None:
        parts.append(f"begun {text_module.moment(when.first_us)}")
        parts.append(text_module.duration(round((when.last_us - when.first_us) / 1e6)))
    return parts


def _figures(record: MergedRecord, single_copies: list[str]) -> list[tuple[str, str]]:
    header = record.header
    building = sum(block.line.events for block in record.unfinished)
    figures: list[tuple[str, int | str]] = [
        ("vehicles with an export", f"{len(record.collected.latest)} of {len(header.roster)}"),
        ("events", header.events),
        ("blocks", header.blocks - len(record.unfinished)),
        ("blocks in the mutual chain", header.mutual_chain),
        ("distinct chains", header.distinct_chains),
        ("blocks with one vehicle only", len(single_copies) - len(record.unfinished)),
        ("events in current blocks", building),
        ("blocks lost", header.lost_blocks),
    ]
    return [(label, text_module.value(value)) for label, value in figures]


def _trees(
    record: MergedRecord, reconciliation: ReconciledExports | None, ink: Mapping[int, AgentColours]
) -> list[tuple[str, Markup]] | None:
    """Return pictures of the chains before and after the reconcile. Return None if a picture would have too many
    blocks.
    """
    exports = record.collected.exports
    if len(record.blocks) > MAX_TREE_BLOCKS:
        return None
    drawn = [("As exported" if reconciliation else "", _tree(exports, record, ink, "home"))]
    if reconciliation is not None:
        drawn.append(("After the final reconcile", _tree(reconciliation.exports, record, ink, "reconciled")))
    return drawn


def _tree(exports: Mapping[int, Export], record: MergedRecord, ink: Mapping[int, AgentColours], key: str) -> Markup:
    return ChainTreePicture(exports, ink, key, record.names).draw("abridged")


def _vehicles(record: MergedRecord, ink: Mapping[int, AgentColours]) -> list[dict[str, Any]]:
    """Return a table row for each export, and for each vehicle that has no export."""
    rows: list[dict[str, Any]] = [
        {
            "agent_id": used.agent_id,
            "ink": ink[used.agent_id],
            "why": "",
            "exported": text_module.moment(used.exported_at_us) + ("" if used.latest else ", earlier"),
            "cells": (used.completed, used.chain, used.deque, used.stack, used.idle),
            "file": used.file,
        }
        for used in record.header.exports
    ]
    absent = [
        {"agent_id": missing_block.agent_id, "ink": ink[missing_block.agent_id], "why": missing_block.why}
        for missing_block in record.missing
    ]
    return sorted(rows + absent, key=lambda row: row["agent_id"])


def _changes(matches: Sequence[MatchedLog], ink: Mapping[int, AgentColours]) -> list[dict[str, Any]]:
    """Return the changes that the flight logs show, such as a new flight mode, in order of time. Flight logs whose
    agent is unknown are omitted.
    """
    found = [change for match in matches if match.agent_id is not None for change in changes(match)]
    return [
        {
            "at": text_module.moment(change.at_us),
            "agent_id": change.agent_id,
            "ink": ink[change.agent_id],
            "words": change.words,
        }
        for change in sorted(found, key=lambda change: change.at_us)
        if change.agent_id is not None
    ]


def _marks(matches: Sequence[MatchedLog]) -> dict[int, list[_time_chart.Mark]]:
    """Return the changes that the flight log of each agent shows. The times are those of the agent's clock."""
    marks: dict[int, list[_time_chart.Mark]] = {}
    for match in matches:
        if match.agent_id is not None:
            ahead_us = round((match.clock_ahead_s or 0.0) * MICROSECONDS)
            of_agent = marks.setdefault(match.agent_id, [])
            of_agent += [(change.at_us + ahead_us, change.words) for change in changes(match)]
    return marks


def _row(block: Block, ink: Mapping[int, AgentColours]) -> dict[str, object]:
    places = []
    for held in block.held:
        position = "" if held.position is None else f" {held.position}"
        places.append(f"{agents(held.agents)} {held.place}{position}")
    return {
        "number": block.number,
        "name": block.name,
        "ink": ink[block.agent_id],
        "at": text_module.moment(block.timestamp_us),
        "events": block.events,
        "held": "; ".join(places),
        "block_hash": block.block_hash or "",
    }
