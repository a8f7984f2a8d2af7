"""Write a merged record as files, and summarise it in sentences.

The files are JSON Lines (`harness.field.depot.record_lines`), a CSV table, and tracks for maps.
"""

import csv
import io
from binascii import b2a_base64
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from harness.field.depot.consolidation import MergedRecord, RecordedBlock, events_in
from harness.field.depot.record_lines import Fork, ForkBranch, MissingItem, ReconcileResult, RecordLine
from harness.field.flight_logs import Position
from harness.field.flight_logs._matching import MatchedLog, match_logs
from harness.field.flight_logs._matching import in_words as flight_log_in_words
from harness.report.chain_tree import ranges
from harness.report.logbook.positions import LAST_TIMESTAMP_US, EventTrack, RoundedPosition, track_of, utc
from ucp.events import LoggableEvent
from ucp.telemetry import describe, position_of

COLUMNS = (
    *("number", "block", "block_hash", "mutual", "copies", "index", "agent", "timestamp_us", "time"),
    *("event_id", "words", "lat", "lon", "alt_m", "data"),
)


def lines(record: MergedRecord, reconciled: ReconcileResult | None = None) -> Iterator[str]:
    """Yield the lines of the merged record, each with its line end."""
    yield _line(record.header)
    yield from map(_line, record.forks)
    for block in record.blocks:
        yield _line(block.line)
        yield _event_lines(block)
    yield from map(_line, record.lost)
    if reconciled is not None:
        yield _line(reconciled)


def _line(line: RecordLine) -> str:
    return line.model_dump_json(by_alias=True) + "\n"


def _event_lines(block: RecordedBlock) -> str:
    """Return the lines for a block's events, in the format of the model `Event`.

    The model is too slow for a million events.
    """
    data, beginning = block.event_data, f'{{"line":"event","block":{block.line.number},"index":'
    middle = f',"agent_id":{block.line.agent_id},"timestamp_us":'
    return "".join(
        [
            f'{beginning}{index}{middle}{timestamp_us},"event_id":{event_id},"data":"'
            f'{b2a_base64(data[begin:end], newline=False).decode("ascii")}"}}\n'
            for index, (timestamp_us, event_id, begin, end) in enumerate(events_in(data))
        ]
    )


def table(record: MergedRecord) -> str:
    """Return a CSV table with a row for each event, in the order of the record.

    Data is hexadecimal, and times are UTC.
    """
    out = io.StringIO(newline="")
    writer = csv.writer(out)
    writer.writerow(COLUMNS)
    for block in record.blocks:
        line = block.line
        copies = len(line.holders)
        for index, event in enumerate(block.events):
            has_telemetry = record.collected.telemetry
            position = position_of(event.event_id, event.data) if has_telemetry else None
            place = (position.lat_e7 / 1e7, position.lon_e7 / 1e7, position.alt_mm / 1e3) if position else ("", "", "")
            writer.writerow(
                (
                    *(line.number, line.name, line.block_hash or "", int(line.mutual), copies, index, line.agent_id),
                    *(event.timestamp_us, utc(event.timestamp_us) if event.timestamp_us <= LAST_TIMESTAMP_US else ""),
                    *(event.event_id, describe(event.event_id, event.data) if has_telemetry else "", *place),
                    event.data.hex(),
                )
            )
    return out.getvalue()


def flight_logs(record: MergedRecord) -> list[MatchedLog]:
    """Return the flight logs, each with the agent of its vehicle."""
    if not record.collected.flight_logs:
        return []  # the events of all blocks need not be decoded
    logged = {track.agent_id: track.fixes for track in tracks(record)}
    return match_logs(record.collected.flight_logs, {agent: logged.get(agent, []) for agent in record.header.roster})


def flown_tracks(matches: Iterable[MatchedLog]) -> list[EventTrack]:
    """Return the flight path from each flight log that belongs to an agent. Times are UTC if the log has GPS time.
    Otherwise they are times on the log's clock.
    """
    return [
        EventTrack(match.agent_id, [], [_fix(position) for position in match.vehicle.positions])
        for match in matches
        if match.agent_id is not None and match.vehicle.positions
    ]


def _fix(position: Position) -> tuple[int, RoundedPosition]:
    at_us = position.at_us if position.utc_us is None else position.utc_us
    place = (round(position.lat_deg * 1e7), round(position.lon_deg * 1e7), round(position.alt_m * 1e3))
    return at_us, RoundedPosition(*place)


def tracks(record: MergedRecord) -> list[EventTrack]:
    """Return the path of each agent that logged positions, by agent ID. The result is empty if the events are not
    telemetry.
    """
    logged: dict[int, list[tuple[LoggableEvent, str]]] = {}
    for block in record.blocks if record.collected.telemetry else ():
        name = block.line.name
        logged.setdefault(block.line.agent_id, []).extend((event, name) for event in block.events)
    agent_tracks = (track_of(agent_id, logged[agent_id]) for agent_id in sorted(logged))
    return [track for track in agent_tracks if track.fixes]


MAX_FORKS = 5
MAX_NAMES = 8


def in_words(record: MergedRecord, reconciled: ReconcileResult | None = None, *, opened: bool = False) -> Iterator[str]:
    """Yield sentences about the exports, the places at which chains differ, the blocks that only one vehicle holds, the
    lost blocks, and the reconcile. `opened` is true if the depot's key was given.
    """
    header = record.header
    with_export = sorted(record.collected.latest)
    fraction = (
        f"{len(with_export)} of {len(header.roster)} vehicles"
        if len(with_export) < len(header.roster)
        else _count(with_export, "vehicle")
    )
    building = sum(block.line.events for block in record.unfinished)
    in_progress = f", {building} of them in current blocks" if building else ""
    blocks = header.blocks - len(record.unfinished)
    events = "1 event" if header.events == 1 else f"{header.events} events"
    yield f"{fraction} have an export ({agents(with_export)}), with {_blocks(blocks)} and {events}{in_progress}"
    if header.distinct_chains == 1:
        subject = "all have one chain" if len(with_export) > 1 else "it has a chain"
        yield f"{subject} of {_blocks(header.mutual_chain)}"
    else:
        yield (
            f"{header.distinct_chains} distinct chains; the mutual chain has {_blocks(header.mutual_chain)}, "
            f"the longest {header.longest_chain}"
        )
    if sealed := sum(block.line.sealed for block in record.blocks):
        blocks_sealed = _blocks(sealed)
        yield (
            f"{blocks_sealed} not opened by this key: sealed by another agent than the one named, or damaged"
            if opened
            else f"{blocks_sealed} sealed to the depot: read them with --depot-key and the depot key of this mission"
        )
    yield from map(fork_in_words, record.forks[:MAX_FORKS])
    if len(record.forks) > MAX_FORKS:
        yield f"and the chains differ at {len(record.forks) - MAX_FORKS} more places"
    yield from _single_copies(record)
    yield from missing_in_words(record.lost_blocks)
    yield from (missing.why for missing in record.missing)
    yield from map(flight_log_in_words, flight_logs(record))
    if reconciled is not None:
        yield from reconciled_in_words(reconciled)


def fork_in_words(fork: Fork) -> str:
    where = f"after {_blocks(fork.height)}, at {fork.after}" if fork.after else "at the inception block"
    return f"chains differ {where}: {'; '.join(map(branch_in_words, fork.ways))}"


def branch_in_words(branch: ForkBranch) -> str:
    single_copies = len(branch.agents) == 1
    if branch.next is None:
        return f"{agents(branch.agents)} end{'s' if single_copies else ''}"
    return f"{agents(branch.agents)} go{'es' if single_copies else ''} on with {branch.next}"


def missing_in_words(lost: Sequence[MissingItem]) -> Iterator[str]:
    """Yield a sentence for each group of lost blocks of one agent with the same reason."""
    by_reason: dict[str, list[MissingItem]] = {}
    for each in lost:
        by_reason.setdefault(each.why, []).append(each)
    for why, group in by_reason.items():
        names = [each.block or "" for each in group]
        yield f"lost: {'block' if len(names) == 1 else f'{len(names)} blocks,'} {_first_names(names)}: {why}"


def reconciled_in_words(reconciled: ReconcileResult) -> Iterator[str]:
    vehicles = reconciled.vehicles
    rounds = "1 round" if reconciled.rounds == 1 else f"{reconciled.rounds} rounds"
    if reconciled.uniform:
        yield f"reconciled in {rounds}: one chain of {_blocks(len(reconciled.chain))} on {_count(vehicles, 'vehicle')}"
    else:
        chains = Counter(vehicle.top_chain_hash for vehicle in vehicles)
        yield f"reconciled in {rounds}: the chains did not become one, there are {len(chains)} of them"
    gains = [f"{vehicle.agent_id} gained {len(vehicle.gained)}" for vehicle in vehicles if vehicle.gained]
    if gains:
        yield f"blocks that vehicles received: {', '.join(gains)}"
    if reconciled.left_out:
        yield f"not in all chains: {_first_names(reconciled.left_out)}"


def agents(ids: Sequence[int]) -> str:
    return ", ".join(ranges([*ids]))


def _single_copies(record: MergedRecord) -> Iterator[str]:
    """Yield a sentence for each vehicle that is the only holder of some blocks. If this vehicle had been lost, these
    blocks would not exist any more.
    """
    if len(record.collected.latest) < 2:
        return
    single_copies: dict[int, list[str]] = {}
    for block in record.blocks:
        holders = block.line.holders
        if len(holders) == 1:
            single_copies.setdefault(holders[0], []).append(block.line.name)
    for agent_id, names in sorted(single_copies.items()):
        verb = "is" if len(names) == 1 else "are"
        yield f"{_blocks(len(names))} {verb} with vehicle {agent_id} only: {_first_names(names)}"


def _blocks(number: int) -> str:
    return "1 block" if number == 1 else f"{number} blocks"


def _first_names(names: Sequence[str]) -> str:
    more = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return ", ".join(names[:MAX_NAMES]) + more


def _count(things: Sequence[object], what: str) -> str:
    return f"1 {what}" if len(things) == 1 else f"{len(things)} {what}s"
