"""The consolidated record as others read it: lines (`harness.field.depot.record_lines`), a table, and tracks for
maps."""

import csv
import io
from binascii import b2a_base64
from collections.abc import Iterator

from harness.field.depot.consolidation import BlockOnRecord, Consolidation, events_in
from harness.field.depot.record_lines import Line, Reconciled
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
