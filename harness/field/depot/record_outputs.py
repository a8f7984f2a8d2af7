"""The consolidated record as files, and its summary in sentences.

The files are JSON Lines (`harness.field.depot.record_lines`), a CSV table, and tracks for maps.
"""

import csv
import io
from binascii import b2a_base64
from collections import Counter
from collections.abc import Iterator, Sequence

from harness.field.depot.consolidation import BlockOnRecord, Consolidation, events_in
from harness.field.depot.record_lines import Fork, Line, Lost, Reconciled, Way
from harness.report.chain_tree import ranges
from harness.report.logbook.positions import LAST_TIMESTAMP_US, Track, track_of, utc
from ucp.events import LoggableEvent
from ucp.telemetry import describe, position_of

COLUMNS = (
    *("number", "block", "block_hash", "mutual", "copies", "index", "agent", "timestamp_us", "time"),
    *("event_id", "words", "lat", "lon", "alt_m", "data"),
)


def lines(record: Consolidation, reconciled: Reconciled | None = None) -> Iterator[str]:
    """The record, line by line, each with its end."""
    yield _line(record.header)
    yield from map(_line, record.forks)
    for block in record.blocks:
        yield _line(block.line)
        yield _event_lines(block)
    yield from map(_line, record.lost)
    if reconciled is not None:
        yield _line(reconciled)


def _line(line: Line) -> str:
    return line.model_dump_json(by_alias=True) + "\n"


def _event_lines(block: BlockOnRecord) -> str:
    """As the model `Event` writes them, of which there may be a million."""
    number, agent_id, data = block.line.number, block.line.agent_id, block.event_data
    return "".join(
        [
            f'{{"line":"event","block":{number},"index":{index},"agent_id":{agent_id},"timestamp_us":{timestamp_us},'
            f'"event_id":{event_id},"data":"{b2a_base64(data[begin:end], newline=False).decode("ascii")}"}}\n'
            for index, (timestamp_us, event_id, begin, end) in enumerate(events_in(data))
        ]
    )


def table(record: Consolidation) -> str:
    """A row for each event, in the order of the record; data is hexadecimal, times are UTC."""
    out = io.StringIO(newline="")
    writer = csv.writer(out)
    writer.writerow(COLUMNS)
    for block in record.blocks:
        line = block.line
        copies = len(line.holders)
        for index, event in enumerate(block.events):
            telling = record.home.telemetry
            position = position_of(event.event_id, event.data) if telling else None
            place = (position.lat_e7 / 1e7, position.lon_e7 / 1e7, position.alt_mm / 1e3) if position else ("", "", "")
            writer.writerow(
                (
                    *(line.number, line.name, line.block_hash or "", int(line.mutual), copies, index, line.agent_id),
                    *(event.timestamp_us, utc(event.timestamp_us) if event.timestamp_us <= LAST_TIMESTAMP_US else ""),
                    *(event.event_id, describe(event.event_id, event.data) if telling else "", *place),
                    event.data.hex(),
                )
            )
    return out.getvalue()


def tracks(record: Consolidation) -> list[Track]:
    """A track of each agent that logged positions, by agent ID; none if events are no telemetry."""
    logged: dict[int, list[tuple[LoggableEvent, str]]] = {}
    for block in record.blocks if record.home.telemetry else ():
        name = block.line.name
        logged.setdefault(block.line.agent_id, []).extend((event, name) for event in block.events)
    made = (track_of(agent_id, logged[agent_id]) for agent_id in sorted(logged))
    return [track for track in made if track.fixes]


FORKS_TOLD = 5
NAMES_TOLD = 8


def in_words(record: Consolidation, reconciled: Reconciled | None = None, *, opened: bool = False) -> Iterator[str]:
    """What came home, where chains part, what one vehicle alone has, what was lost, and what a reconcile made of it.

    `opened`: the depot's key was there.
    """
    header = record.header
    home = sorted(record.home.latest)
    of_all = (
        f"{len(home)} of {len(header.roster)} vehicles" if len(home) < len(header.roster) else _count(home, "vehicle")
    )
    building = sum(block.line.events for block in record.unfinished)
    being_built = f", {building} of them in current blocks" if building else ""
    blocks = header.blocks - len(record.unfinished)
    events = "1 event" if header.events == 1 else f"{header.events} events"
    yield f"{of_all} have an export ({agents(home)}), with {_blocks(blocks)} and {events}{being_built}"
    if header.distinct_chains == 1:
        whose = "all have one chain" if len(home) > 1 else "it has a chain"
        yield f"{whose} of {_blocks(header.mutual_chain)}"
    else:
        yield (
            f"{header.distinct_chains} distinct chains; the mutual chain has {_blocks(header.mutual_chain)}, "
            f"the longest {header.longest_chain}"
        )
    if sealed := sum(block.line.sealed for block in record.blocks):
        closed = _blocks(sealed)
        yield (
            f"{closed} not opened by this key: sealed by another agent than the one named, or damaged"
            if opened
            else f"{closed} sealed to the depot: read them with --depot-key and the depot key of this mission"
        )
    yield from map(fork_in_words, record.forks[:FORKS_TOLD])
    if len(record.forks) > FORKS_TOLD:
        yield f"and the chains differ at {len(record.forks) - FORKS_TOLD} more places"
    yield from _rare(record)
    yield from lost_in_words(record.lost_blocks)
    yield from (missing.why for missing in record.missing)
    if reconciled is not None:
        yield from reconciled_in_words(reconciled)


def fork_in_words(fork: Fork) -> str:
    where = f"after {_blocks(fork.height)}, at {fork.after}" if fork.after else "at the inception block"
    return f"chains differ {where}: {'; '.join(map(way_in_words, fork.ways))}"


def way_in_words(way: Way) -> str:
    alone = len(way.agents) == 1
    if way.next is None:
        return f"{agents(way.agents)} end{'s' if alone else ''}"
    return f"{agents(way.agents)} go{'es' if alone else ''} on with {way.next}"


def lost_in_words(lost: Sequence[Lost]) -> Iterator[str]:
    """A sentence for each agent whose blocks were lost for the same reason."""
    by_reason: dict[str, list[Lost]] = {}
    for each in lost:
        by_reason.setdefault(each.why, []).append(each)
    for why, alike in by_reason.items():
        names = [each.block or "" for each in alike]
        yield f"lost: {'block' if len(names) == 1 else f'{len(names)} blocks,'} {_few(names)}: {why}"


def reconciled_in_words(reconciled: Reconciled) -> Iterator[str]:
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
        yield f"not in all chains: {_few(reconciled.left_out)}"


def agents(ids: Sequence[int]) -> str:
    return ", ".join(ranges([*ids]))


def _rare(record: Consolidation) -> Iterator[str]:
    """What the next loss would have taken."""
    if len(record.home.latest) < 2:
        return
    alone: dict[int, list[str]] = {}
    for block in record.blocks:
        holders = block.line.holders
        if len(holders) == 1:
            alone.setdefault(holders[0], []).append(block.line.name)
    for agent_id, names in sorted(alone.items()):
        yield f"{_blocks(len(names))} {'is' if len(names) == 1 else 'are'} with vehicle {agent_id} only: {_few(names)}"


def _blocks(number: int) -> str:
    return "1 block" if number == 1 else f"{number} blocks"


def _few(names: Sequence[str]) -> str:
    more = f" and {len(names) - NAMES_TOLD} more" if len(names) > NAMES_TOLD else ""
    return ", ".join(names[:NAMES_TOLD]) + more


def _count(things: Sequence[object], what: str) -> str:
    return f"1 {what}" if len(things) == 1 else f"{len(things)} {what}s"
